from pathlib import Path

import pytest
from synthetic_flights.cameras import MAVIC, MAVIC_3M, SENTERA_6X
from synthetic_flights.panel import make_flight_between_panels
from synthetic_flights.troubles import make_two_headings

from agalign.synthetic.cameras import REDEDGE

from ..conftest import Shared

SUN = 1.0, 0.6
CAMERAS = {"RedEdge": REDEDGE, "M3M calibrated": MAVIC, "M3M": MAVIC_3M, "6X": SENTERA_6X}


def capture_by(camera: str, shared: Shared) -> Path:
    """The images of one capture by a camera of `CAMERAS`."""

    def fill(folder: Path) -> None:
        make_two_headings(folder, 1, (480, 360), camera=CAMERAS[camera], line=1, lakes=False)

    return shared(f"capture by {camera}", fill)


@pytest.fixture(scope="session")
def between_panels(shared: Shared) -> Path:
    """The panel, two captures, and the panel again, while the sun goes down."""
    return shared("between_panels", lambda folder: make_flight_between_panels(folder, 2, (640, 480), sun=SUN))
