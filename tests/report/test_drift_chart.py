"""The chart of the offsets of a flight, from the data of the report."""

import tracemalloc

from agalign.report.charts import drifts_of
from agalign.report.facts import CameraOffsets


def test_the_memory_is_proportional_to_the_number_of_captures() -> None:
    """A season has 20,000 captures: a matrix of all pairs of them does not fit into memory."""
    count = 4000
    offsets = [{"NIR": (0.01 * (number % 7), 0.02 * (number % 5))} for number in range(count)]
    camera = CameraOffsets([(f"{number:05}", f"{number:05}", one) for number, one in enumerate(offsets)])
    tracemalloc.start()
    (chart,) = drifts_of({"RedEdge": camera})
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 1000 * count
    assert chart["ends"] == ("00000", "03999")
