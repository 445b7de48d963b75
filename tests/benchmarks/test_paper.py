"""The rows of the paper's experiments."""

from paper import EXPERIMENTS, rows_of

from agalign.evaluation.evaluate import Result


def test_a_row_has_the_starts_of_its_method_and_distances() -> None:
    starts = (0.0, 0.5), (0.1, 1.5), (0.15, 0.9), (0.2, 7.0)
    results = [
        Result("1", "pairs", method, shift, 0.0, 100, average_precision, error_px)
        for method, average_precision in (("fast:pseudo-siamese", 0.5), ("sift", 1.0))
        for shift, error_px in starts
    ]
    near, far = rows_of(EXPERIMENTS["fast"]["distances"], results)
    assert (near.n, near.cells) == ("2 starts", {"mAP": "0.500", "error under 1 px": 1, "worst, px": "1.50"})
    assert (far.n, far.cells["error under 1 px"], far.cells["worst, px"]) == ("2 starts", 1, "7.00")
