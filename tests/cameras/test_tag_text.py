"""Numbers and times in tags, as programs of any locale write them."""

from pathlib import Path

import pytest

from agalign.cameras.tag_text import iso_time, numbers_in


@pytest.mark.parametrize(
    ("items", "count", "expected"),
    [
        (("80.18",), 1, (80.18,)),
        (("80,18",), 1, (80.18,)),
        (("-5,0893e-07",), 1, (-5.0893e-07,)),
        (("1/500",), 1, (0.002,)),
        (("12.5 mm",), 1, (12.5,)),
        (("+69.99",), 1, (69.99,)),
        (("2.39919,1.8389",), 2, (2.39919, 1.8389)),
        (("2,39919,1,8389",), 2, (2.39919, 1.8389)),
        (("640,480",), 2, (640.0, 480.0)),
        (("0.07, -0.02, 0.06",), 3, (0.07, -0.02, 0.06)),
        (("0,07, -0,02, 0,06",), 3, (0.07, -0.02, 0.06)),
        (("0, -0,02, 0,06",), 3, (0.0, -0.02, 0.06)),
        (("0,07; -0,02; 0,06",), None, (0.07, -0.02, 0.06)),
        (("-0,11", "0,24", "0"), 5, (-0.11, 0.24, 0.0)),
        (("475,560,668",), 1, (475.0, 560.0, 668.0)),
        (("(451,496), (538,497)",), None, (451.0, 496.0, 538.0, 497.0)),
        (("1.#QNAN",), 1, ()),
        (("nan",), 1, ()),
        (("-1.#IND", "2"), 2, ()),
        (("0.1, inf, 0.3",), 3, ()),
        (("unknown",), 1, ()),
        (("",), 1, ()),
        (("5/0",), 1, ()),
        (("1e300",), 1, ()),
    ],
)
def test_numbers(items: tuple[str, ...], count: int | None, expected: tuple[float, ...]) -> None:
    assert numbers_in(items, count) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (("2021:08:27 19:34:57",), "2021-08-27T19:34:57"),
        (("2021-08-27T19:34:57",), "2021-08-27T19:34:57"),
        (("2021/08/27 19:34:57",), "2021-08-27T19:34:57"),
        (("2021-08-27T19:34:57.25Z",), "2021-08-27T19:34:57.25+00:00"),
        (("2021-08-27T19:34:57+0530",), "2021-08-27T19:34:57+05:30"),
        (("2021:08:27 19:34:57", "25", "+02:00"), "2021-08-27T19:34:57.25+02:00"),
        (("2021:08:27 19:34:57", "-394485", "+99:00"), "2021-08-27T19:34:57"),
        (("27.08.2021 19:34:57",), ""),
        (("",), ""),
    ],
)
def test_times(given: tuple[str, ...], expected: str) -> None:
    assert iso_time(*given) == expected


def test_no_other_module_parses_numbers_of_tags() -> None:
    cameras = Path(__file__).parents[2] / "agalign" / "cameras"
    others = [p.name for p in cameras.glob("*.py") if "float(part)" in p.read_text() or "strptime" in p.read_text()]
    assert others == []
