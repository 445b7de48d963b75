"""`agalign indices` within this process."""

import json
from pathlib import Path

import pytest
from synthetic_flights.aligned import make_aligned
from typer.testing import CliRunner

from agalign.cli.main import app
from agalign.synthetic import flight as synthetic

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.mark.parametrize("name", ["indices", "ndvi"])
def test_indices_are_written_and_summed_up(tmp_path: Path, name: str) -> None:
    make_aligned(tmp_path, 2)
    done = CliRunner().invoke(app, [name, str(tmp_path), "--index", "ndvi,NDRE", "--formula", "x=N/R"])
    assert done.exit_code == 0, done.output
    assert "6 of 6 written" in done.stdout
    assert done.stderr == ""
    assert len(list(tmp_path.rglob("*_x.tif"))) == len(list(tmp_path.rglob("*_ndre.png"))) == 2


def test_raw_numbers_are_announced_first(tmp_path: Path) -> None:
    make_aligned(tmp_path, 1, raw=True)
    done = CliRunner().invoke(app, ["indices", str(tmp_path), "-v"])
    first, second = done.stderr.splitlines()
    assert "raw numbers, not reflectance" in first
    assert "--radiometry auto" in first
    assert "IMG_0001 ndvi: median" in second


def test_reports_as_json(tmp_path: Path) -> None:
    make_aligned(tmp_path, 1)
    done = CliRunner().invoke(app, ["indices", str(tmp_path), "--index", "ndvi,evi", "--json"])
    assert done.exit_code == 3, "there is no blue band"
    ndvi, evi = json.loads(done.stdout)["indices"]
    assert (ndvi["capture"], ndvi["unit"], ndvi["problem"]) == ("0000SET/IMG_0001", "reflectance", None)
    assert ndvi["p5"] < ndvi["median"] < ndvi["p95"]
    assert (evi["path"], evi["median"]) == (None, None)
    assert "evi needs a blue band" in evi["problem"]


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--index", "xyz"], "unknown index 'xyz'"), (["--formula", "import os"], "is not a formula"),
        (["--index", "ndvi,ndvi"], "'ndvi' is given twice"), (["--index", ","], "--index is empty"),
        (["--formula", "N/R", "--formula", "N/G"], "'formula' is given twice"),
    ],
)  # fmt: skip
def test_wrong_indices_are_usage_errors_of_one_line(tmp_path: Path, options: list[str], problem: str) -> None:
    make_aligned(tmp_path, 1)
    done = CliRunner().invoke(app, ["indices", str(tmp_path), *options])
    assert done.exit_code == 2
    (line,) = done.stderr.splitlines()
    assert problem in line


def test_a_run_announces_indices_of_raw_numbers_too(tmp_path: Path) -> None:
    synthetic.make_flight(tmp_path / "in", captures=1, size_px=(160, 120))
    said = [
        CliRunner().invoke(app, ["align", str(tmp_path / "in"), "--index", "ndvi", "--dry-run", *options]).stderr
        for options in ([], ["--radiometry", "auto"])
    ]
    assert ["raw numbers, not reflectance" in text for text in said] == [True, False]
