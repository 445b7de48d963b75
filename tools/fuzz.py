"""Coverage-guided fuzzing of what is read from a card: tags, XMP packets, and the names of files.

    pip install atheris
    python tools/fuzz.py [--inputs 200000] [--figures]
    python tools/fuzz.py --target xmp --inputs 10000       one target, with libFuzzer's own output

An input fails where anything but an AgalignError is raised, where it takes longer than a second, or where the process
comes to hold more than 500 MB. Inputs begin from the files of a synthetic flight of each camera. What failed is left in
the working folder, as `crash-…`, `timeout-…` or `oom-…`, to be given to `--target` as an argument of its own.
"""

import contextlib
import logging
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tifffile
import typer

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

from figures_csv import FiguresOption, TableRow, write_figures

SHARES = {"xmp": 0.5, "tags": 0.35, "names": 0.15}
MAX_SECONDS, MAX_MEGABYTES = 1, 500
LONGEST_BYTES = {"xmp": 20_000, "tags": 30_000, "names": 300}


def seeds(folder: Path) -> None:
    """Write the initial corpus of each target."""
    from synthetic_flights.cameras import ALTUM, MAVIC, MAVIC_3M, SENTERA_6X

    from agalign.cameras.tiff_directory import XMP, read_directories
    from agalign.synthetic.cameras import REDEDGE
    from agalign.synthetic.flight import make_flight

    for target in SHARES:
        (folder / target).mkdir(parents=True)
    for camera in (REDEDGE, MAVIC, MAVIC_3M, ALTUM, SENTERA_6X):
        made = folder / "made" / camera.model.replace(" ", "_")
        make_flight(made, 1, (32, 24), camera=camera)
        images = sorted(p for p in made.rglob("*") if p.suffix.lower() in (".tif", ".jpg"))
        for path in images:
            if packet := read_directories(path)[0].get(XMP):
                (folder / "xmp" / path.name).write_bytes(packet.data)
            if path.stat().st_size < LONGEST_BYTES["tags"]:
                (folder / "tags" / path.name).write_bytes(path.read_bytes())
        (folder / "names" / made.name).write_text("\n".join(path.name for path in images))
    (folder / "names" / "generic").write_text("a_red.tif\na_nir.tif\nb-840nm.tiff\nDJI_0011.TIF\n.hidden.tif\n_1.tif")


def fuzz(target: str, corpus: Path, arguments: list[str]) -> None:
    """Run libFuzzer in this process, and exit."""
    import atheris

    with atheris.instrument_imports(include=["agalign.cameras", "agalign.values", "tifffile"]):
        from agalign.cameras import discover, metadata, pix4d, read_files, tag_transfer, xmp
        from agalign.cameras.makers import known_cameras
        from agalign.cameras.tiff_directory import read_directories
    from agalign.errors import AgalignError
    from agalign.values.capture import Band

    for library in ("tifffile", "rasterio", "PIL"):
        logging.getLogger(library).setLevel(logging.CRITICAL + 1)
    cameras = known_cameras()
    scratch = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    file = scratch / "IMG_0001_1.tif"
    stored = (Band("", file, 1, 1280, 960, "uint16"),)
    plain = scratch.parent / f"{scratch.name}.tif"
    tifffile.imwrite(plain, np.zeros((8, 8), np.uint16))

    def on_xmp(data: bytes) -> None:
        packet = xmp.Packet.parse(data)
        for make in ("MicaSense", "DJI", "Parrot", "Sentera", "MAPIR", ""):
            tags = metadata.Tags(make=make, model="x", xmp=packet.values())
            camera = next(c for c in cameras if c.recognises(tags))
            bands = camera.bands(file, tags, stored)
            camera.with_shared_rig(bands, [tags] * len(bands))
            camera.pose(tags)
            camera.motion(tags)
            pix4d.panel_in(tags, (1280, 960))
        other = xmp.Packet.parse(packet.serialised())
        packet.take(other, [("pix4d.com/camera", "BandName")])

    def on_tags(data: bytes) -> None:
        file.write_bytes(data)
        with contextlib.suppress(AgalignError):
            read_files.read_file(file, cameras, discover.DiscoverOptions())
        with contextlib.suppress(AgalignError):
            metadata.read_tags(file)
        tag_transfer._directories(file)
        with contextlib.suppress(ValueError):
            read_directories(file)

    def on_names(data: bytes) -> None:
        with tempfile.TemporaryDirectory(dir=scratch) as folder, contextlib.suppress(AgalignError):
            for name in data.decode("utf-8", "surrogateescape").split("\n")[:8]:
                with contextlib.suppress(OSError, ValueError):
                    os.link(plain, Path(folder, name))
            discover.discover(Path(folder))

    limits = f"-timeout={MAX_SECONDS} -rss_limit_mb={MAX_MEGABYTES} -max_len={LONGEST_BYTES[target]}"
    options = [*limits.split(), "-print_final_stats=1", "-verbosity=1"]
    test_one = {"xmp": on_xmp, "tags": on_tags, "names": on_names}[target]
    atheris.Setup([sys.argv[0], *options, *arguments, str(corpus)], test_one)
    atheris.Fuzz()


def fuzz_in_process(target: str, inputs: int, corpus: Path) -> tuple[str, str]:
    """(numbers of a target in a process of its own, without its `{seconds}`; error, if any)."""
    command = [sys.executable, __file__, "--target", target, "--inputs", str(inputs), "--corpus", str(corpus)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    stats = Counter({name: int(value) for name, value in re.findall(r"stat::(\w+):\s+(\d+)", done.stdout)})
    _, found, uncaught = done.stdout.partition("=== Uncaught")
    error = (found + uncaught if found else done.stdout)[-3000:] if done.returncode else ""
    limits = f"{int(bool(error))} failures, slowest {stats['slowest_unit_time_sec']} s, {stats['peak_rss_mb']} MB"
    return f"{target} {stats['number_of_executed_units']} in {{seconds}} s ({limits})", error


def main(
    inputs: int = 200_000,
    target: Literal["xmp", "tags", "names"] | None = None,
    corpus: Path | None = None,
    libfuzzer: Annotated[list[str] | None, typer.Argument(help="options and files for libFuzzer")] = None,
    *,
    figures: FiguresOption = False,
) -> None:
    from common import timed

    if figures and target:
        sys.exit("--figures writes the figures of all targets; omit --target")
    if target and corpus:
        fuzz(target, corpus, [f"-runs={inputs}", *(libfuzzer or ())])
    with tempfile.TemporaryDirectory() as folder:
        seeds(Path(folder))
        parts, errors = [], []
        for one, share in SHARES.items() if target is None else {target: 1.0}.items():
            seconds, (part, error) = timed(fuzz_in_process, one, round(inputs * share), Path(folder, one))
            parts.append(part.format(seconds=round(seconds)))
            errors += [error] if error else []
        print(f"Inputs: {', '.join(parts)}.")
        if figures:
            name = "random tags, XMP and file names"
            write_figures([TableRow("reliability", name, f"{inputs:,} inputs", {"failures": len(errors)})])
        if errors:
            raise SystemExit("\n".join(errors))


if __name__ == "__main__":
    from common import run

    run(main)
