"""Shared by the benchmarks: arguments, tables, runs of the command line, and errors at ground truth."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import rasterio
import typer
from bands.score import WRONG_PX, table
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from agalign.pixels.gdal import without_warnings
from agalign.rasters.read_alignment import read_alignment
from agalign.records.sidecar import BandResult, Sidecar
from agalign.records.sidecar_file import find_sidecars, read_sidecar
from agalign.values.geometry import Points

Ties = dict[str, dict[str, Any]]
"""Entries of ties.json or truth.json by the name of the moving file, each with `ties` (n, 4), raw px."""
Number = Annotated[int, typer.Argument()]
"""A positional argument of a script, with a default."""


def run(main: Callable[..., None]) -> None:
    """Call the function of a script with the arguments of its command line; the script's docstring is its help.

    Unknown options go to a last argument that takes a list.
    """
    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    paragraphs = sys.modules["__main__"].__doc__.split("\n\n")
    # After \b a paragraph keeps its lines.
    text = "\n\n".join(f"\b\n{paragraph}" for paragraph in paragraphs)
    app.command(help=text, context_settings={"ignore_unknown_options": True})(main)
    app()


def timed(function: Callable[..., Any], *arguments: Any, **options: Any) -> tuple[float, Any]:
    """Call a function; return (seconds, result)."""
    began = time.perf_counter()
    result = function(*arguments, **options)
    return time.perf_counter() - began, result


def cpu_timed(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Call a function; return (CPU seconds of all threads of this process, result)."""
    began = time.process_time()
    result = function(*arguments)
    return time.process_time() - began, result


# ---- tables


def print_row(*cells: object) -> None:
    """Print a row of a Markdown table."""
    print(table([cells]).partition("\n")[0], flush=True)


def print_head(*cells: str) -> None:
    """Print the head of a Markdown table."""
    print(table([cells]), flush=True)


def with_section(document: Path, name: str, content: str) -> str:
    """Return the text of a document with other content between the comments of a section."""
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    before, found, rest = document.read_text(encoding="utf-8").partition(begin)
    if not found or end not in rest:
        raise SystemExit(f"{document} has no section {begin.strip()}")
    return before + begin + content + end + rest.partition(end)[2]


def cell(values: Sequence[float] | NDArray[Any], style: str, statistic: Callable[..., Any] = np.median) -> str:
    """Return a statistic of the values that are not nan, "-" without any."""
    known = np.asarray(values)[~np.isnan(values)]
    return format(statistic(known), style) if len(known) else "-"


def pyplot() -> Any:
    """Return matplotlib.pyplot for figures in files."""
    from matplotlib import pyplot

    pyplot.switch_backend("Agg")
    return pyplot


def heat_map(axis: Any, values: NDArray[np.float64], rows: Sequence[str], columns: Sequence[str], **style: Any) -> Any:
    """Draw shares (rows, columns) as coloured cells with percentages, - for nan. `style` has options of imshow."""
    image = axis.imshow(np.nan_to_num(values), vmin=0, vmax=1, aspect="auto", **style)
    for (row, column), value in np.ndenumerate(values):
        is_dark = not np.isnan(value) and np.mean(image.cmap(value)[:3]) < 0.4
        text, colour = "-" if np.isnan(value) else f"{value:.0%}", "white" if is_dark else "black"
        axis.text(column, row, text, ha="center", va="center", fontsize=8, color=colour)
    axis.set_xticks(range(len(columns)), columns, rotation=40, ha="right")
    axis.set_yticks(range(len(rows)), rows)
    return image


# ---- bands of files


def read_band(path: Path, index: int = 1) -> NDArray[Any]:
    """Return the pixels (height, width) of a band as they are stored."""
    with without_warnings(), rasterio.open(path) as dataset:
        return np.asarray(dataset.read(index))


def write_band(path: Path, pixels: NDArray[Any], index: int = 1) -> None:
    """Replace the pixels of a band, and leave the tags."""
    with without_warnings(), rasterio.open(path, "r+") as dataset:
        dataset.write(pixels, index)


def change_band(path: Path, change: Callable[[NDArray[Any]], NDArray[Any]], index: int = 1) -> None:
    """Replace the pixels of a band by a function of them, within the range of their type but for 0, for no data."""
    pixels = read_band(path, index)
    write_band(path, change(pixels).clip(1, np.iinfo(pixels.dtype).max).astype(pixels.dtype), index)


# ---- runs of the command line


def command(flight: Path, out: Path, *options: str) -> list[str]:
    """Return the command that aligns a folder, quietly unless it logs."""
    quiet = () if "--log-json" in options else ("-q",)
    return [sys.executable, "-m", "agalign", str(flight), "-o", str(out), *quiet, *options]


def align(flight: Path, out: Path, *options: str) -> float:
    """Align a folder, and return the seconds. Bands that are not aligned end the program with exit code 3."""
    return timed(subprocess.run, command(flight, out, *options), check=False)[0]


def writable_copy(folder: Path, copy: Path) -> None:
    """Copy a folder, in which files may be read-only, so that the copy can be changed."""
    shutil.copytree(folder, copy, copy_function=shutil.copyfile)
    for path in (copy, *copy.rglob("*/")):
        path.chmod(0o755)


@contextmanager
def flight_and_out() -> Iterator[tuple[Path, Path]]:
    """Return two names in a temporary folder: of a flight, and of the output of a run."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder) / "flight", Path(folder) / "out"


@dataclass(frozen=True)
class Ending:
    """How a run ended, and what it printed."""

    code: int | None
    """None if it was killed after the time limit; negative if a signal ended it."""
    errors: str
    out: str = ""
    seconds: float = np.nan

    @property
    def has_traceback(self) -> bool:
        return "Traceback" in self.errors or "please report" in self.errors

    @property
    def complaints(self) -> list[str]:
        return [line for line in self.errors.splitlines() if line.startswith("agalign: ")]


def ended(
    argv: Sequence[str], max_s: float, disturb: Callable[[Any], object] = lambda _: None, **options: Any
) -> Ending:
    """Run a command, call a function with its process, and kill its process group after the time limit."""
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "errors": "replace"}
    began = time.perf_counter()
    with subprocess.Popen(argv, **pipes, start_new_session=True, **options) as process:
        disturb(process)
        try:
            errors, code = process.communicate(timeout=max_s)[1], process.returncode
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            errors, code = process.communicate()[1], None
    return Ending(code, errors, seconds=time.perf_counter() - began)


@dataclass(frozen=True)
class Watched:
    """Resources of a process and its descendants."""

    code: int
    seconds: float
    largest_gb: float
    """Peak memory of the largest process."""
    samples: NDArray[np.float64]
    """(n, 4) every half second: seconds, own memory in MB, open files, processes."""
    left: list[Any]
    """Processes that outlived it."""


def watched(argv: Sequence[str]) -> Watched:
    """Run a command and sample its resources."""
    import psutil

    began, samples, seen = time.monotonic(), [], set[psutil.Process]()
    process = subprocess.Popen(argv)
    here = psutil.Process(process.pid)
    while not (result := os.wait4(process.pid, os.WNOHANG))[0]:
        children = here.children(recursive=True)
        values = np.zeros(3)
        for one in (here, *children):
            with suppress(psutil.Error, OSError):
                values += one.memory_full_info().uss / 1e6, one.num_fds(), 1
        seen.update(children)
        samples.append((time.monotonic() - began, *values))
        time.sleep(0.5)
    seconds = time.monotonic() - began
    _, left = psutil.wait_procs(seen, timeout=10)
    _, status, usage = result
    process.returncode = os.waitstatus_to_exitcode(status)
    return Watched(process.returncode, seconds, usage.ru_maxrss / 1e6, np.array(samples), left)


# ---- errors at ground truth


@dataclass(frozen=True)
class BandError:
    """Error of a moving band at its tie points."""

    sidecar: Sidecar
    part: BandResult
    """The band in it."""
    std_px: float
    """Expected error of the band; nan without one."""
    error_px: Points
    """(n,)"""
    claim_px: Points
    """(n,) values of the error map; nan outside, or without a map."""

    @property
    def name(self) -> str:
        return f"{self.sidecar.capture} {self.part.band}"

    @property
    def is_usable(self) -> bool:
        """Aligned, or predicted within --accept-predicted."""
        return self.part.is_usable(self.sidecar.accept_predicted_px)

    @property
    def median_px(self) -> float:
        return float(np.nanmedian(self.error_px))

    @property
    def p95_px(self) -> float:
        return float(np.nanpercentile(self.error_px, 95))


def read_ties(path: Path) -> Ties:
    """Return the truth of a ties.json or truth.json by file; nothing if there is no such file."""
    result: Ties = {}
    if not path.is_file():
        return result
    for capture in json.loads(path.read_text(encoding="utf-8")).values():
        shared = {"reference": capture["reference"], "trouble": capture.get("trouble", "")}
        result |= {file: entry | shared for file, entry in capture["bands"].items()}
    return result


def band_errors(out: Path, truth: Ties) -> list[BandError]:
    """Return the error of each band with tie points by the mappings in the sidecars of a run.

    If the run has another reference than the truth, its points are mapped to that one first.
    """
    result = []
    for path in find_sidecars(out):
        sidecar = read_sidecar(path)
        references = {Path(b.file).name: b.band for b in sidecar.bands if b.status != "reference"}
        for band in sidecar.bands:
            file = Path(band.file).name
            if file not in truth or band.status == "reference" or band.homography is None:
                continue
            alignment, prediction = read_alignment(path, band.band), band.prediction
            points, target = np.hsplit(np.array(truth[file]["ties"]), 2)
            if truth[file]["reference"] in references:
                points = read_alignment(path, references[truth[file]["reference"]]).inverse(points)
            std_px = prediction.std_px if prediction else band.joint.corner_std_px if band.joint else None
            known_std_px = std_px if band.status in ("aligned", "predicted") and std_px is not None else np.nan
            error_px = np.linalg.norm(alignment.map(points) - target, axis=1)
            result.append(BandError(sidecar, band, known_std_px, error_px, claims_px(path, sidecar, band.band, points)))
    return result


def only_sidecar(out: Path) -> tuple[Path, Sidecar]:
    """Return the one sidecar below the output of a run, with its path."""
    (path,) = find_sidecars(out)
    return path, read_sidecar(path)


def window_of(sidecar: Sidecar) -> tuple[slice, slice]:
    """Return the rows and columns of the reference in the output."""
    x0, y0, width, height = sidecar.output.crop
    return np.s_[y0 : y0 + height, x0 : x0 + width]


def layer(path: Path, name: str) -> NDArray[np.float64] | None:
    """Return the band (height, width) of a raster with a name, nan where it has no data; None without file or band."""
    if not path.exists():
        return None
    with without_warnings(), rasterio.open(path) as dataset:
        if name not in dataset.descriptions:
            return None
        band = dataset.read(dataset.descriptions.index(name) + 1, masked=True)
    return np.asarray(band.astype(np.float64).filled(np.nan))


def claims_px(path: Path, sidecar: Sidecar, band: str, points_px: Points) -> Points:
    """Return the error map (n,) of a band at raw points (n, 2) of the reference; nan outside, or without a map."""
    values = layer(path.with_suffix(".error.tif"), band)
    if values is None:
        return np.full(len(points_px), np.nan)
    x0, y0 = sidecar.output.crop[:2]
    axes = (np.arange(n) + at for n, at in zip(values.shape, (y0, x0), strict=True))
    return np.asarray(RegularGridInterpolator(tuple(axes), values, bounds_error=False)(points_px[:, ::-1]))


def print_errors(groups: dict[str, list[BandError]]) -> None:
    """Print a row for each group of bands, and a line for each band that is off or without result; errors are medians
    over a band's tie points.
    """
    head = "captures", "bands", "median error, px", "worst", "worst error / std", "within 1 std", "within 2 std"
    print_head("", *head)
    for name, bands in groups.items():
        errors, std = np.array([(b.median_px, b.std_px) for b in bands]).T
        parts = [b.part for b in bands]
        statuses = Counter(f"{p.status} ({p.prediction.source})" if p.prediction else p.status for p in parts)
        counts = ", ".join(f"{n} {status}" for status, n in statuses.most_common())
        shares = errors / std
        cells = f"{np.median(errors):.3f}", f"{errors.max():.3f}", cell(shares, ".1f", np.max)
        within = [f"{np.mean(shares <= k):.0%}" for k in (1, 2)]
        print_row(name, len({b.sidecar.capture for b in bands}), counts, *cells, *within)
    for name, bands in groups.items():
        for b in bands:
            if b.median_px > WRONG_PX or b.part.status not in ("aligned", "predicted"):
                print(f"{name}: {b.name}: {b.part.status}, {b.median_px:.2f} px, expected error {b.std_px:.2f}")
