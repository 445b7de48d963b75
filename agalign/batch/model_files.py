"""Files of the models in OUT/models: which one is that of a flight, and the name of a new one."""

from collections.abc import Collection, Sequence
from pathlib import Path

from agalign.flight.groups import model_name
from agalign.host.files import MODELS_FOLDER
from agalign.host.own_files import is_own_file
from agalign.records.cautions import models_in
from agalign.values.capture import Capture


class ModelFiles:
    """Models of this and of earlier runs. A run replaces only models of its own flights, recognised by a fingerprint:
    flights of other input folders may have the same camera.
    """

    def __init__(self, out: Path) -> None:
        self._folder, self._fingerprints = out / MODELS_FOLDER, models_in(out)
        of_others = {path for path in self._folder.glob("*") if not is_own_file(path)}
        # A damaged model is replaced. Some file systems do not distinguish upper and lower case.
        self._taken = {path.name.lower() for path in of_others.union(self._fingerprints)}

    def find(self, captures: Sequence[Capture], fingerprints: Collection[str]) -> Path | None:
        """Return the model of a flight, which has one of these fingerprints; None if there is none."""
        paths = self._paths(captures)
        return next((path for path in paths if self._fingerprints.get(path) in fingerprints), None)

    def new(self, captures: Sequence[Capture]) -> Path:
        """Return the path for the first model of a flight: the first name that no model and no other file has."""
        return next(path for path in self._paths(captures) if path.name.lower() not in self._taken)

    def add(self, path: Path, fingerprint: str) -> None:
        """Note that a model was written."""
        self._fingerprints[path] = fingerprint
        self._taken.add(path.name.lower())

    def _paths(self, captures: Sequence[Capture]) -> list[Path]:
        """Return possible names of the model of a flight; at least one is free."""
        return [self._folder / model_name(captures[0], number) for number in range(1, len(self._taken) + 2)]
