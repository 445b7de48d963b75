import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.env import PROJDataFinder

from agalign.errors import ConfigurationError, GeometryError
from agalign.pixels import coordinates
from agalign.pixels.coordinates import transformed

from ..builders import in_full_run
from ..cli.test_onto import write_mosaic
from ..conftest import read_json
from ..program import agalign


def test_coordinates_between_reference_systems() -> None:
    result = transformed(np.array([[0.0, 1000.0]]), "+proj=aeqd +lat_0=52 +lon_0=5 +datum=WGS84", "EPSG:4326")
    np.testing.assert_allclose(result, [[5.0, 52.00899]], atol=1e-4)
    with pytest.raises(GeometryError, match="cannot be transformed"):
        transformed(np.zeros((1, 2)), "EPSG:0", "EPSG:4326")


def data_of_another_proj(folder: Path, kind: str) -> Path:
    """A folder without proj.db, or with that of an old version."""
    folder.mkdir()
    if kind == "old":
        shutil.copy(Path(PROJDataFinder().search()) / "proj.db", folder)
        with sqlite3.connect(folder / "proj.db") as database:
            database.execute("UPDATE metadata SET value = '1' WHERE key = 'DATABASE.LAYOUT.VERSION.MINOR'")
        database.close()
    return folder


SCRIPT = """
from concurrent.futures import ThreadPoolExecutor
import numpy as np
import rasterio
from agalign.pixels.coordinates import crs_wkt, transformed
from agalign.pixels.raster import open_raster

with open_raster({path!r}) as mosaic:
    assert mosaic.crs.to_epsg() == 32633
with ThreadPoolExecutor(1) as pool:
    print(*pool.submit(transformed, np.array([[5.0, 52.0]]), "EPSG:4326", "EPSG:32631").result().round()[0])
print(crs_wkt("EPSG:32631")[:28])
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variable", "kind"), [("PROJ_LIB", "empty"), in_full_run("PROJ_DATA", "old"), in_full_run("GDAL_DATA", "empty")]
)
def test_data_of_another_installation_are_not_used(variable: str, kind: str, tmp_path: Path) -> None:
    """rasterio reads the variable when it is imported, so that a process of its own is needed."""
    write_mosaic(tmp_path / "mosaic.tif", np.ones((60, 60), np.float32), (0, 0))
    environment = os.environ | {variable: str(data_of_another_proj(tmp_path / "data", kind))}
    script = SCRIPT.replace("{path!r}", f"__import__('pathlib').Path({str(tmp_path / 'mosaic.tif')!r})")
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ('637294.0 5762927.0\nPROJCS["WGS 84 / UTM zone 31\n', "")


@pytest.mark.full
def test_a_run_with_data_of_another_installation_is_georeferenced(flight: Path, tmp_path: Path) -> None:
    environment = os.environ | {"PROJ_LIB": str(data_of_another_proj(tmp_path / "data", "empty"))}
    arguments = (flight, "-o", tmp_path / "out", "--only-seed", "--georeference", "--ground-elevation", "0")
    done = agalign(*arguments, "--jobs", "2", env=environment)
    assert "PROJ" not in done.stderr
    with rasterio.open(tmp_path / "out" / "0000SET" / "000" / "IMG_0001.tif") as stack:
        assert stack.crs.to_epsg() == 32631
    assert read_json(tmp_path / "out" / "0000SET" / "000" / "IMG_0001.json")["footprint"]


def test_the_variable_is_named_if_rasterio_has_no_data(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    coordinates._ensure_proj_data.cache_clear()
    monkeypatch.setenv("PROJ_LIB", str(tmp_path))
    monkeypatch.delenv("PROJ_DATA", raising=False)
    monkeypatch.setattr(coordinates, "_has_usable_data", lambda: False)
    with pytest.raises(ConfigurationError, match=f"^PROJ_LIB={tmp_path}: .*; unset PROJ_LIB$"):
        transformed(np.zeros((1, 2)), "EPSG:4326", "EPSG:32631")
    assert os.environ["PROJ_LIB"] == str(tmp_path)
