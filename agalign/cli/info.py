"""The command `agalign info`: the captures of a folder, or the contents of a model."""

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agalign.cli.align_commands import align
from agalign.cli.command import Command, Given
from agalign.cli.config_file import config_text
from agalign.cli.terminal import MAX_LISTED, ExitCode, Terminal, in_json
from agalign.errors import ConfigurationError, UnreadableFileError
from agalign.host.text import counted

if TYPE_CHECKING:
    from agalign.cameras.discover import FolderScan
    from agalign.values.capture import Capture


def _info(
    terminal: Terminal,
    given: Given,
    folder: Annotated[Path | None, typer.Argument()] = None,
    as_json: Annotated[bool, typer.Option("--json")] = False,
    options: bool = False,
) -> int:
    """List cameras, captures, bands and missing files of a folder, or show the rig of a model.

    Options:
        folder: Folder with images, or the model of a run (OUT/models/….safetensors).
        as_json: Print JSON to standard output.
        options: Print a configuration file (--config) with all options of align.
    """
    if options:
        typer.echo(config_text(align.built()))
        return ExitCode.OK
    if folder is None:
        raise ConfigurationError("give a folder with images, a model, or --options")
    if folder.is_file() and folder.suffix == ".safetensors":
        _show_model(folder, terminal, as_json=as_json)
        return ExitCode.OK
    return _show_folder(folder, given["discover"], terminal, as_json=as_json)


info = Command(_info, {"Input": "pattern reference bands order with_rgb ignore_metadata include exclude"})


def _show_folder(folder: Path, options: dict[str, Any], terminal: Terminal, *, as_json: bool) -> int:
    """Print the captures of a folder, and return the exit code. Raises InputError if it contains no image."""
    from agalign.cameras.discover import discover
    from agalign.cli.align_run import print_found
    from agalign.config import DiscoverOptions
    from agalign.flight.groups import camera_overviews

    flight = discover(folder, DiscoverOptions(**options))
    rows, captures = _rows(flight)
    cameras = camera_overviews(captures)
    if as_json:
        problems = [{"file": str(p.path), "problem": p.text} for p in flight.problems]
        facts = {"folder": str(folder), "cameras": [vars(c) for c in cameras], "captures": rows, "problems": problems}
        terminal.facts(facts)
    else:
        print_found(flight, terminal)
        for camera in cameras:
            terminal.result(camera.text)
        if rows:
            _show_captures(rows, len(flight.problems), terminal)
        else:
            _show_unused(flight, terminal)
    return ExitCode.NOTHING if not rows else ExitCode.OK if flight.is_complete else ExitCode.PARTIAL


def _rows(flight: "FolderScan") -> tuple[list[dict[str, Any]], list["Capture"]]:
    """Return what `info` prints about the captures of a folder, as JSON objects, and the captures with their panels."""
    from agalign.flight.panel_readings import with_panels
    from agalign.flight.sky import sky_captures

    sky, others = sky_captures(flight.captures)
    sky_cues = {s.capture.label: list(s.cues) for s in sky}
    by_label = {c.label: c for c in (*with_panels(others), *(s.capture for s in sky))}
    unreadable = _unreadable_files(flight)
    captures = [by_label[c.label] for c in flight.captures]
    rows = [_facts(c) | {"sky": sky_cues.get(c.label, []), "unreadable_files": unreadable[c.label]} for c in captures]
    return rows, captures


def _show_captures(rows: Sequence[dict[str, Any]], problems: int, terminal: Terminal) -> None:
    """Print the captures of a folder as a table, the calibration panels and sky captures, and a line of totals."""
    from agalign.values.remedies import MISSING_BAND

    headers = ("Capture", "Camera", "Taken", "Bands (reference in brackets)", "Seeds", "Missing")
    table = []
    for row in rows:
        bands = ", ".join(f"[{b['name']}]" if b["reference"] else str(b["name"]) for b in row["bands"])
        taken, seeds = row["captured_at"][:19].replace("T", " "), ", ".join(row["seeds"])
        missing = [*row["missing_bands"], *(f"{name} (unreadable)" for name in row["unreadable_files"])]
        table.append((row["label"], row["camera"], taken, bands, seeds, ", ".join(missing)))
    terminal.table(headers, table)
    if any(row["missing_bands"] for row in rows):
        terminal.result(f"missing: {MISSING_BAND.cause}; {MISSING_BAND.advice}")
    for row in rows:
        if row["panel"] is not None:
            where = ", aligned as well" if row["panel_in_scene"] else ""
            terminal.result(f"{row['label']}: calibration panel {row['panel']}".rstrip() + where)
        if row["sky"]:
            terminal.result(f"{row['label']}: shows the sky ({', '.join(row['sky'])}); not aligned")
    total_bands = sum(len(r["bands"]) for r in rows)
    parts = counted(len(rows), "capture"), counted(total_bands, "band"), counted(problems, "problem")
    terminal.result(", ".join(parts))


def _unreadable_files(flight: "FolderScan") -> dict[str, list[str]]:
    """Return the unreadable files of each capture by label: those of its bands, and others with names that begin with
    the capture's name, and not with a longer number.
    """
    result: dict[str, list[str]] = defaultdict(list)
    for path in (p.path for p in flight.problems if isinstance(p.error, UnreadableFileError)):
        in_folder = [c for c in flight.captures if c.reference.path.parent == path.parent]
        named = [c for c in in_folder if re.match(rf"{re.escape(c.name)}(?!\d)", path.name)]
        candidates = named + [c for c in in_folder if _is_of(path, c)]
        if candidates:
            result[max(candidates, key=lambda c: len(c.name)).label].append(path.name)
    return result


def _is_of(path: Path, capture: "Capture") -> bool:
    """Return True for the file of a band of a capture that cannot be read."""
    return any(reason.what.startswith(f"{path.name}: ") for reason in capture.unreadable_bands.values())


def _show_unused(flight: "FolderScan", terminal: Terminal) -> None:
    """Print what a folder without captures contains, and why none of it is used."""
    from agalign.cameras.image_search import image_files, other_files
    from agalign.pixels.raster import IMAGE_KINDS

    reasons: Counter[tuple[str, str]] = Counter()
    known = {p.path: p.text.removeprefix(f"{p.path}: ") for p in flight.problems}
    images, _ = image_files(flight.folder, ())
    no_band = (
        "a colour photograph or a part of no capture; name files '<capture>_<band>.tif', give --pattern, or use "
        "--with-rgb for photographs next to the bands of a capture"
    )
    for path in images:
        reasons[path.suffix.lower(), known.get(path, no_band)] += 1
    for suffix, number in other_files(flight.folder).items():
        reasons[suffix, f"not an image that agalign reads ({IMAGE_KINDS})"] += number
    terminal.problem(f"{flight.folder}: no capture of two or more bands in it")
    for (kind, reason), total in reasons.most_common(MAX_LISTED):
        terminal.result(f"{counted(total, kind + ' file')}: {reason}")


def _show_model(path: Path, terminal: Terminal, *, as_json: bool) -> None:
    """Print the contents of a model. Raises InputError if the file is not a model."""
    from agalign.flight.model import load_model
    from agalign.flight.rig_prediction import band_summaries
    from agalign.method.device import choose_device

    model = load_model(path, lambda: choose_device("cpu"))
    rows = [] if model.rig is None else band_summaries(model.rig)
    captures, factors = (0, ()) if model.rig is None else (len(model.rig.captures), model.rig.factors)
    if as_json:
        rig = {"captures": captures, "factors": factors, "bands": rows} if rows else None
        facts = {"model": str(path), "camera": str(model.camera or ""), "bands": list(model.bands), "rig": rig}
        facts |= {"folder": model.folder, "captured_at": list(model.captured_at)}
        terminal.facts(facts)
        return
    terminal.result(f"{model.camera or 'any camera'}: a network for {', '.join(model.bands) or 'any bands'}")
    if model.folder or model.captured_at:
        times = " to ".join(time[:19].replace("T", " ") for time in model.captured_at) or "at an unknown time"
        terminal.result(f"flight: {times}, in the folder {model.folder} of its input")
    if not rows:
        terminal.result("no rig: too few captures were aligned")
        return
    headers = "Band", "Pixel, px of the reference", "Offset at the centre", "Baseline"
    of_errors = "By bands", "By neighbours", "By the flight"
    table = []
    for row in rows:
        (dx, dy), (bx, by) = row["offset_px"], row["baseline"]
        lengths = ("pixel_size_px", "from_bands_px", "from_neighbours_px", "from_flight_px", "field_px")
        pixel, *errors = ("none" if row[k] is None else f"{row[k]:.2f}" for k in lengths)
        table.append((row["band"], pixel, f"{dx:+.1f}, {dy:+.1f}", f"{bx:+.2f}, {by:+.2f}", *errors))
    title = "The rig: offset of each band, and error of its prediction (RMS, px of the band)"
    terminal.table((*headers, *of_errors, "Largest lens displacement"), table, title, texts=1)
    shared = ", ".join(factors) or "nothing"
    terminal.result(f"rig learned from {captures} captures; variations that the bands of a capture share: {shared}")


def _facts(capture: "Capture") -> dict[str, Any]:
    """Return what `info` prints about a capture, as a JSON object."""
    from agalign.cameras.tag_seeds import tag_seeds
    from agalign.config import SeedSettings

    offered = {kind for b in capture.moving for kind in tag_seeds(capture.reference, b, SeedSettings())}
    bands = [
        {
            "name": b.name,
            "file": str(b.path),
            "band_index": b.band_index,
            "wavelength_nm": b.wavelength_nm,
            "width": b.width_px,
            "height": b.height_px,
            "dtype": b.dtype,
            "nodata": in_json(b.nodata),
            "lens_model": b.lens is not None,
            "reference": b is capture.reference,
        }
        for b in capture.bands
    ]
    return {
        "label": capture.label,
        "camera": capture.camera.name or "unknown",
        "serial": capture.camera.serial,
        "captured_at": capture.known_time,
        "capture_id": capture.capture_id,
        "flight_id": capture.flight_id,
        "bands": bands,
        "seeds": [kind for kind in ("rig", "geo") if kind in offered] + ["structure", "identity"],
        "missing_bands": list(capture.missing_bands),
        "panel": None if capture.panel is None else capture.panel.serial,
        "panel_in_scene": capture.panel is not None and capture.panel.in_scene,
    }
