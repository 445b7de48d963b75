"""The names that `import agalign` offers, and what its objects print."""

import operator
import pydoc
import re
import typing
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

import agalign
from agalign import api, config, errors
from agalign.config import JointSettings, Settings
from agalign.values.issues import BLANK_MOVING, Issue
from agalign.values.mapping import PixelMapping

from .builders import joint_result, residual_of

FUNCTIONS = "align align_capture align_folder dask_executor discover export indices onto open_capture open_flight"
FUNCTIONS += " read_alignment warp_onto"
SETTINGS = "CheckSettings FlightSettings JointSettings ReliefSettings SeedSettings Settings WriteSettings"
RESULTS = "Alignment Capture CaptureReport ExportReport FlightReports FolderScan IndexReport MappingError MovedArea"
RESULTS += " Prediction Residual Seed"
OPTIONS = "DiscoverOptions RunOptions"
ERRORS = """AgalignError ConfigurationError GeometryError InputError NoContrastError NoSuchBandError
NotEnoughTextureError OutputError SidecarError UnreadableFileError WorkerError"""


def test_the_public_names() -> None:
    names = {*f"{FUNCTIONS} {SETTINGS} {RESULTS} {OPTIONS} {ERRORS}".split(), "__version__"}
    assert set(agalign.__all__) == set(dir(agalign)) == names
    assert len(agalign.__all__) == len(names)
    for name in names:
        assert getattr(agalign, name) is not None
    with pytest.raises(AttributeError, match="'nothing'"):
        agalign.nothing  # noqa: B018


def test_all_errors_and_settings_are_public() -> None:
    raised = {n for n, c in vars(errors).items() if isinstance(c, type) and issubclass(c, Exception)}
    assert raised == set(ERRORS.split())
    stages = {type(getattr(config.Settings(), name)).__name__ for name in config.Settings.model_fields}
    assert stages | {"Settings"} == set(SETTINGS.split())


@pytest.mark.parametrize("name", ["align", "align_capture", "align_folder", "export", "indices", "onto"])
def test_types_in_the_signatures_are_public(name: str) -> None:
    hints = typing.get_type_hints(getattr(api, name))
    own = {t for hint in hints.values() for t in (hint, *typing.get_args(hint)) if hasattr(t, "__module__")}
    ours = {t.__name__ for t in own if t.__module__.startswith("agalign") and hasattr(t, "__name__")}
    assert ours
    assert ours <= set(agalign.__all__)


@pytest.mark.parametrize("name", [*FUNCTIONS.split(), *RESULTS.split()])
def test_help_prints_names_of_array_types(name: str) -> None:
    assert "_NestedSequence" not in pydoc.render_doc(getattr(agalign, name))


def test_settings_print_values_other_than_defaults() -> None:
    assert repr(agalign.Settings()) == "Settings()"
    changed = agalign.Settings(write=agalign.WriteSettings(layout="both", qa=True))
    assert repr(changed) == "Settings(write=WriteSettings(layout='both', qa=True))"


def test_names_in_the_text_of_an_alignment_are_attributes() -> None:
    residual, joint = residual_of(np.zeros((4, 2)), (0.3, 0.4)), joint_result(std_px=0.25)
    prediction = agalign.Prediction(np.eye(3), "windows", 0.4)
    facts = {"residual": residual, "joint": joint, "prediction": prediction}
    seed = agalign.Seed("identity", np.eye(3), 0.0)
    result = agalign.Alignment(PixelMapping(np.eye(3)), (64, 48), (Issue(BLANK_MOVING),), seed, **facts)
    shown = dict(re.findall(r"([\w.]+)=('[^']*'|[^,)]+)", repr(result)))
    assert {"status", "residual.median_px", "joint.corner_std_px", "reason"} == set(shown)
    for name, text in shown.items():
        value = operator.attrgetter(name)(result)
        assert text == repr(value) if isinstance(value, str) else float(text) == pytest.approx(value, rel=0.01)


ROOT = Path(__file__).parent.parent


WRONG = {"recipe": "slow", "sharing": "none", "model_family": "similarity", "device": 1, "fast": {}, "longest_px": 4096}


@pytest.mark.parametrize(("name", "value"), [*WRONG.items(), *(("rng_seed", v) for v in (-1, 2**63, 0.5))])
def test_one_error_names_the_setting_that_is_wrong(name: str, value: object) -> None:
    with pytest.raises(ValidationError) as raised:
        Settings.model_validate({"joint": {name: value}})
    (error,) = raised.value.errors()
    assert error["loc"] == ("joint", name)


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        JointSettings().rng_seed = 1


def test_every_setting_has_an_option() -> None:
    """The list of options, which test_documents.py compares with the command line, has them all."""
    text = (ROOT / "docs" / "reference" / "settings.md").read_text(encoding="utf-8")
    stages = {stage: type(value) for stage, value in vars(Settings()).items()}
    settings = {f"{stage}.{name}" for stage, fields in stages.items() for name in fields.model_fields}
    settings.remove("flight.start_model")  # the fingerprint of a given model: set by the run
    assert settings == set(re.findall(r"^\* `([a-z_]+\.[a-z_]+)\b", text, re.MULTILINE))
    assert 15 < len(settings) <= 30
