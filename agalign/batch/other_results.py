"""Results in the output folder of captures that the input of this run does not have."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from agalign.batch.earlier_results import is_same
from agalign.cameras.discover import FolderScan
from agalign.errors import SidecarError
from agalign.flight.fingerprint import input_samples
from agalign.records.run_record import NotInInputPart, RunPart
from agalign.records.sidecar import Sidecar
from agalign.records.sidecar_file import find_sidecars, label_of, read_without_tables
from agalign.values.capture import Capture


def labels_of_other_inputs(earlier: RunPart | None, record: RunPart) -> dict[str, list[str]]:
    """Return the labels of the captures that earlier runs found in other input folders, by folder, without those of
    this run; flights may be aligned folder by folder into one output folder.
    """
    if earlier is None:
        return {}
    found, own = {**earlier.other_inputs, earlier.input: earlier.labels}, set(record.labels)
    others = {folder: [label for label in labels if label not in own] for folder, labels in found.items()}
    return {folder: labels for folder, labels in others.items() if labels and folder != record.input}


def results_not_in_input(
    flight: FolderScan, out: Path, other_inputs: Mapping[str, Sequence[str]]
) -> Iterator[NotInInputPart]:
    """Yield the results of captures that are in no input folder: their images were removed, or have another name and
    are a capture of this run. Images that exist, and are not selected, are in the input.
    """
    own, others = {c.label for c in flight.captures}, {label for labels in other_inputs.values() for label in labels}
    exposures: _Exposures | None = None
    for path in find_sidecars(out):
        if (label := label_of(path, out)) in own:
            continue
        with suppress(SidecarError):  # named by the commands that read it
            result = read_without_tables(path)
            exposures = exposures or _Exposures(flight.captures)
            if same := exposures.same_as(result):
                yield NotInInputPart(capture=label, same_as=same)
            elif label not in others and not any((flight.folder / b.file).is_file() for b in result.bands):
                yield NotInInputPart(capture=label)


class _Exposures:
    """The captures of a run by what identifies their exposure: the id in the tags, else the contents of a file."""

    def __init__(self, captures: Sequence[Capture]) -> None:
        self._captures = captures
        self._by_sample: dict[tuple[str, str], str] | None = None

    def same_as(self, result: Sidecar) -> str:
        """Return the label of the capture that is the same exposure as a result; empty if there is none."""
        if result.capture_id:
            of_id = (c for c in self._captures if c.capture_id == result.capture_id and is_same(result, c))
            return next((c.label for c in of_id), "")
        if self._by_sample is None:
            without_id = [c for c in self._captures if not c.capture_id]
            self._by_sample = {sample: c.label for c in without_id for sample in input_samples(c).items()}
        by_sample = self._by_sample
        return next((by_sample[sample] for sample in result.input_samples.items() if sample in by_sample), "")
