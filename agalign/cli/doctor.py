"""The command `agalign doctor`: checks whether this machine meets the requirements."""

import os
import platform
import re
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from agalign._version import __version__
from agalign.cli.command import Command
from agalign.cli.terminal import ExitCode, Terminal
from agalign.values.processes import usable_cores

_LIBRARIES = ("torch", "numpy", "opencv-python-headless", "rasterio", "tifffile", "scikit-image", "pydantic")
EXTRAS = {
    "dask": "captures on the workers of a Dask cluster (--dask)",
    "evaluate": "elastix in comparison with learned descriptors (agalign evaluate)",
    "indices": "more spectral indices by name (agalign indices --index)",
    "stac": "STAC items and collections (--stac)",
    "xarray": "captures and flights as xarray datasets (agalign.open_capture, agalign.open_flight)",
}


def _doctor(
    terminal: Terminal,
    folder: Annotated[Path, typer.Argument()] = Path(),
    as_json: Annotated[bool, typer.Option("--json")] = False,
) -> int:
    """Check this machine: versions, devices, threads, memory, disk and extras.

    Options:
        folder: Folder for aligned files.
        as_json: Print JSON to standard output.
    """
    from agalign.method.device import devices

    known = [{"device": d.name, "what": d.what, "threads": d.threads, "problem": d.problem} for d in devices()]
    facts = {"machine": _machine(), "disk": _disk(folder), "devices": known, "extras": _extras()}
    problems = _problems(facts)
    if as_json:
        terminal.facts(facts | {"problems": problems})
    else:
        _show(facts, terminal)
        for text in problems:
            terminal.problem(text)
        if not problems:
            terminal.result("no problems found")
    return ExitCode.NOTHING if problems else ExitCode.OK


doctor = Command(_doctor)


def _machine() -> dict[str, Any]:
    from agalign.pixels.raster import gdal_version
    from agalign.products.run.record import library_version

    memory_gb = None
    with suppress(AttributeError, ValueError, OSError):  # not on Windows
        memory_gb = round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    return {
        "agalign": __version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        **{name: library_version(name) for name in _LIBRARIES},
        "gdal": gdal_version(),
        "cores": usable_cores(),
        "memory_gb": memory_gb,
    }


def _disk(folder: Path) -> dict[str, Any]:
    existing = next((p for p in (folder.absolute(), *folder.absolute().parents) if p.is_dir()), Path.cwd())
    free_gb = round(shutil.disk_usage(existing).free / 1e9, 1)
    return {"folder": str(existing), "free_gb": free_gb, "writable": os.access(existing, os.W_OK)}


def _extras() -> list[dict[str, Any]]:
    """Return the purpose and the missing libraries of each extra."""
    from agalign.products.run.record import library_version

    missing = {name: [d for d in _requirements(name) if library_version(d) is None] for name in EXTRAS}
    return [{"extra": name, "adds": adds, "missing": missing[name]} for name, adds in EXTRAS.items()]


def _requirements(extra: str) -> list[str]:
    """Return the distributions that an extra requires, from the metadata of the package."""
    from importlib import metadata

    requirements = metadata.requires("agalign") or []
    return [found[1] for r in requirements if (found := re.match(rf"([\w.-]+).*extra == .{extra}\b", r))]


def _problems(facts: dict[str, Any]) -> list[str]:
    machine, disk = facts["machine"], facts["disk"]
    problems = [f"{name} is not installed; install agalign again" for name in _LIBRARIES if machine[name] is None]
    problems += [
        f"{d['device']}: {d['problem']}; choose another with --device" for d in facts["devices"] if d["problem"]
    ]
    if not disk["writable"]:
        problems.append(f"{disk['folder']}: may not be written to; choose another folder with -o")
    min_free_disk_gb = 5.0  # half of what a thousand captures take
    if disk["free_gb"] < min_free_disk_gb:
        problems.append(f"{disk['folder']}: {disk['free_gb']:.1f} GB are free; a thousand captures take 10 GB or more")
    return problems


def _show(facts: dict[str, Any], terminal: Terminal) -> None:
    machine, disk = facts["machine"], facts["disk"]
    rows = [
        (name.replace("_gb", ", GB"), "unknown" if value is None else str(value)) for name, value in machine.items()
    ]
    writable = "" if disk["writable"] else ", not writable"
    rows.append(("disk", f"{disk['free_gb']:.1f} GB free at {disk['folder']}{writable}"))
    for device in facts["devices"]:
        threads = f", {device['threads']} threads" if device["threads"] else ""
        rows.append((f"device {device['device']}", device["problem"] or device["what"] + threads))
    terminal.table(("This machine", ""), rows)
    extras = [
        (row["extra"], row["adds"], f"pip install '.[{row['extra']}]'" if row["missing"] else "installed")
        for row in facts["extras"]
    ]
    terminal.table(("Extra", "What it adds", "In a checkout"), extras)
