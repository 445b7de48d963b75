"""Which captures are of one camera: what is missing is what that camera's other captures have."""

from pathlib import Path

from agalign.cameras.grouping import with_missing_bands
from agalign.values.capture import Band, CameraIdentity, Capture

RED, BLUE = ("Blue", "Green", "Red"), ("Blue-444", "Green-531")


def capture(name: str, serial: str, bands: tuple[str, ...], model: str = "RedEdge-M") -> Capture:
    files = tuple(Band(b, Path(f"{name}_{b}.tif"), 1, 64, 48, "uint16") for b in bands)
    return Capture(name, Path(), files, 0, CameraIdentity("MicaSense", model, serial))


def missing(*captures: Capture) -> dict[str, tuple[str, ...]]:
    return {c.name: c.missing_bands for c in with_missing_bands(captures)}


def test_two_cameras_of_one_model_lack_none_of_each_other_s_bands() -> None:
    dual = [capture(f"dual{k}", "RB01+RX02", RED + BLUE) for k in range(3)]
    assert missing(*dual, capture("panel", "RM01", RED)) == {"dual0": (), "dual1": (), "dual2": (), "panel": ()}


def test_a_dual_camera_that_lost_a_half_lacks_it_and_stays_the_same_camera() -> None:
    dual = [capture(f"dual{k}", "RB01+RX02", RED + BLUE) for k in range(3)]
    half = capture("half", "RX02", RED)
    assert missing(*dual, half)["half"] == BLUE
    assert with_missing_bands([half, *dual])[0].camera.serial == "RB01+RX02"
    # A half that served in two cameras belongs to neither for certain.
    other = capture("other", "RB07+RX02", RED + BLUE)
    assert with_missing_bands([half, *dual, other])[0].camera.serial == "RX02"


def test_a_capture_without_a_serial_number_is_of_the_only_camera_of_its_model() -> None:
    one = [capture(f"a{k}", "RX02", RED) for k in range(2)]
    assert missing(*one, capture("unknown", "", RED[:2]))["unknown"] == ("Red",)
    assert missing(*one, capture("b", "RX03", RED), capture("unknown", "", RED[:2]))["unknown"] == ()
    assert missing(capture("c", "", RED), capture("d", "", RED), capture("e", "", RED[:2]))["e"] == ("Red",)
    assert missing(*one, capture("altum", "", RED[:2], model="Altum"))["altum"] == ()
