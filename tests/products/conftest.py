from pathlib import Path

import pytest
from synthetic_flights.panel import make_flight_between_panels

from ..conftest import Shared

SUN = 1.0, 0.6


@pytest.fixture(scope="session")
def between_panels(shared: Shared) -> Path:
    """The panel, two captures, and the panel again, while the sun goes down."""
    return shared("between_panels", lambda folder: make_flight_between_panels(folder, 2, (640, 480), sun=SUN))
