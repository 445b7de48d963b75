"""Exports of a run for photogrammetry programs: band files in one folder."""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from agalign.cameras import pix4d
from agalign.cameras.image_file import natural_order
from agalign.cameras.metadata import Tags, read_tags
from agalign.errors import ConfigurationError, InputError, OutputError
from agalign.host.files import (
    check_inside,
    file_name,
    link_or_copy,
    path_problem,
    remove_partial_files,
    scratch_file,
    write_text,
)
from agalign.host.text import counted
from agalign.rasters.aligned_files import BandFiles
from agalign.rasters.band_reader import UNSTATED, BandReader, like_most
from agalign.records.captures import AlignedBand, LeftOut, RunCapture, captures_of_run
from agalign.values.choices import ExportProgram

_NOTES: dict[ExportProgram, str] = {
    "odm": """\
OpenDroneMap, WebODM: the bands of each capture are aligned, and have the tags of one camera.
  --skip-band-alignment --primary-band '{reference}' --radiometric-calibration {calibration}\
 --texturing-skip-global-seam-leveling
{reference} is the reference band.
The files contain {contents}""",
    "metashape": """\
Agisoft Metashape: Workflow, Add Folder, 'Multi-camera system'.
Tools, Camera Calibration: leave the slave offsets at zero (no 'Adjust location', no 'Adjust rotation').
Tools, Set Primary Channel: {reference}.""",
    "pix4d": """\
Pix4Dmapper, Pix4Dfields: add all images; template 'Ag Multispectral'.
Leave the rig's relative parameters as 'Known': they are zero, the bands are aligned.
Radiometric processing needs raw numbers and the captures of the panel from the flight's own folder.""",
}
"""Instructions for the other program."""


@dataclass(frozen=True)
class ExportReport:
    """Result of `export`.

    Examples
    --------
    >>> report = agalign.export("aligned", "for_metashape", "metashape")
    >>> report.captures, len(report.files), report.left_out
    (2, 10, [])
    >>> report.notes[-1]
    'Tools, Set Primary Channel: Green.'
    """

    captures: int
    """Number of exported captures."""
    files: list[Path]
    """The exported files."""
    left_out: LeftOut
    """The skipped captures: (label, reason)."""
    notes: list[str]
    """Instructions for the other program, one per line."""


def export(out: Path, target: Path, program: ExportProgram, *, copy: bool = False) -> ExportReport:
    """Export the captures with status `ok` of the output folder of a run into a new folder.

    The captures have the same bands and quantities as most. Files are hard links if the file system allows that, and
    copies otherwise or with `copy`.
    Raises InputError if there is no run or nothing to export, ConfigurationError if the run wrote no band files,
    OutputError if `target` is not empty, is an address, or cannot be written.
    """
    if problem := path_problem(target):
        raise OutputError(problem)
    captures, left_out = captures_of_run(out)
    good = [c for c in captures if c.result.status == "ok"]
    # A misaligned band harms a reconstruction more than a missing capture.
    left_out += [(c.label, f"its status is {c.result.status}") for c in captures if c.result.status != "ok"]
    good, differing = like_most(good)
    changed = [(c.label, problem) for c in good if (problem := _changed_band_file(c, out))]
    good = [c for c in good if c.label not in dict(changed)]
    left_out += differing + changed
    if not good:
        reason = ": ".join(left_out[0])
        raise InputError(f"{out}: no capture to export ({reason}); 'agalign report {out}' shows what failed")
    with _complete_folder(target) as folder:
        _write_band_files(good, out, folder / "images", copy=copy)
        files = sorted((p for p in folder.rglob("*") if p.is_file()), key=lambda p: natural_order(p.name))
        notes = _notes(program, good, files)
        write_text(folder / "README.txt", "\n".join(notes) + "\n")
    return ExportReport(len(good), [target / path.relative_to(folder) for path in files], left_out, notes)


def _band_files(capture: RunCapture) -> list[Path]:
    return [path for path, part in capture.listed.parts.items() if part.kind == BandFiles.kind]


def _changed_band_file(capture: RunCapture, out: Path) -> str:
    """Return which band file of a capture is not as it was written, with the remedy; empty if all are.

    Raises OutputError if a link leads out of the output folder.
    """
    files = (check_inside(path, out) for path in _band_files(capture))
    return next(filter(None, map(capture.listed.problem, files)), "")


@contextmanager
def _complete_folder(target: Path) -> Iterator[Path]:
    """Yield a hidden folder in an empty or new `target`. If the block succeeds, its contents move to `target`.

    An export that is killed leaves nothing else, and the next one removes it; one that fails leaves no new folder.
    Raises OutputError.
    """
    remove_partial_files(target, below=False)
    is_new = not target.exists()
    try:
        with scratch_file(target / "README.txt") as folder:
            if any(target.iterdir()):
                raise OutputError(f"{target}: is not empty; choose another folder with -o, or delete it")
            try:
                yield folder
            except (OSError, OutputError) as error:
                reason = f"{target}: cannot be written ({error.strerror})" if isinstance(error, OSError) else str(error)
                raise OutputError(reason.replace(str(folder), str(target))) from None
            for path in sorted(folder.iterdir()):
                path.rename(target / path.name)
    finally:
        if is_new:
            with suppress(OSError):  # not empty
                target.rmdir()


def _write_band_files(captures: Sequence[RunCapture], out: Path, images: Path, *, copy: bool) -> None:
    """Link or copy the band files. Raises ConfigurationError and OutputError."""
    taken: dict[str, str] = {}
    for capture in captures:
        files = _band_files(capture)
        if not files:
            raise ConfigurationError(
                f"{out}: has stacks only; run 'agalign' with --layout bands or both into it, and export again"
            )
        if capture.result.write_options.get("format") == "cog":
            raise ConfigurationError(
                f"{out}: the files of {capture.label} are cloud-optimised, without the tags of the camera that other "
                "programs need; run 'agalign' with --format gtiff into it, and export again"
            )
        for file in files:
            source = check_inside(file, out)
            target = images / file_name(file.relative_to(out).as_posix(), taken)
            target.parent.mkdir(parents=True, exist_ok=True)
            link_or_copy(source, target, copy=copy)


def _notes(program: ExportProgram, captures: Sequence[RunCapture], files: Sequence[Path]) -> list[str]:
    outputs = [c.result.output for c in captures if c.result.output is not None]
    facts = {"reference": Counter(c.result.reference.band for c in captures).most_common(1)[0][0]}
    if program == "odm":
        radiometry = "; ".join(sorted({output.radiometry or "" for output in outputs}))
        again = {"calibration": "none", "contents": f"{radiometry}: OpenDroneMap must not calibrate them again."}
        facts |= again if radiometry else _without_radiometry(files)
    notes = _NOTES[program].format(**facts).splitlines()
    flat = sum(output.vignetting_corrected for output in outputs)
    if flat:
        notes.append(f"The vignetting of {counted(flat, 'capture')} is corrected in the pixels of all bands.")
    return notes


def _without_radiometry(files: Sequence[Path]) -> dict[str, str]:
    """The option of OpenDroneMap for files that agalign did not convert."""
    with BandReader() as reader:
        if UNSTATED in reader.units(AlignedBand("", None, files[0], 1)):
            contents = f"numbers whose unit is {UNSTATED}: OpenDroneMap must not calibrate them."
            return {"calibration": "none", "contents": contents}
    if all(_has_light(read_tags(path)) for path in files):
        return {"calibration": "camera+sun", "contents": "raw numbers, and the irradiance of the light sensor."}
    contents = "raw numbers, not all with an irradiance for OpenDroneMap; align with --radiometry for reflectance."
    return {"calibration": "camera", "contents": contents}


def _has_light(tags: Tags) -> bool:
    """True for a thermal band, and for one with an irradiance by which OpenDroneMap divides the radiance.

    That is the horizontal irradiance of a light sensor, without the tag of its unit as W / m^2 / nm, or for DJI the
    irradiance, which fits DJI's relative radiance. Other irradiances are not in the unit of the radiance.
    """
    number = partial(tags.number, pix4d.NAMESPACE)
    if tags.text(pix4d.NAMESPACE, "BandName") == "LWIR":
        return True
    if tags.make == "DJI" and (number("SpectralIrradiance") or number("Irradiance")):
        return True
    return bool(number("HorizontalIrradiance") and number("IrradianceScaleToSIUnits"))
