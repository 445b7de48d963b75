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
    seeded = [Result("1", "pairs", "fast:pseudo-siamese, initial alignment", 0.2, 0.0, 100, 0.5, 0.1)]
    near, far = rows_of("table", EXPERIMENTS["fast"]["distances"], results + seeded)
    assert (near.n, near.cells) == ("2 starts", {"mAP": "0.500", "error under 1 px": 1})
    assert (far.n, far.cells["error under 1 px"]) == ("2 starts", 1)
    (initial,) = rows_of("table", EXPERIMENTS["fast"]["initial"], results + seeded)
    assert (initial.n, initial.cells["error under 1 px"]) == ("1 starts", 1)


def test_a_network_has_no_errors() -> None:
    results = [Result("1", "test", method, 0.05, 0.0, 100, 0.9) for method in ("net.safetensors", "sift")]
    network, _ = rows_of("table", EXPERIMENTS["fast"]["learned"], results)
    assert network.cells == {"mAP": "0.900", "error under 1 px": "-"}
