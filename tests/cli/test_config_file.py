"""Options from a file, what a run would do, and facts as JSON."""

import json
import tomllib
from pathlib import Path

import pytest
from synthetic_flights.aligned import make_aligned
from typer.testing import CliRunner

from agalign.cameras.discover import DiscoverOptions, FolderScan
from agalign.cli import run as cli_run
from agalign.cli.main import app
from agalign.config import Settings
from agalign.synthetic import flight as synthetic

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[tuple[DiscoverOptions, Settings]]:
    """The options and settings that the command makes of its arguments."""
    found: list[DiscoverOptions] = []
    result: list[tuple[DiscoverOptions, Settings]] = []

    def find(folder: Path, options: DiscoverOptions, *_: object) -> FolderScan:
        found.append(options)
        return FolderScan(folder, (), ())

    def run(_flight: object, _out: Path, settings: Settings, *_: object, **__: object) -> None:
        result.append((found[0], settings))
        raise SystemExit(0)

    monkeypatch.setattr(cli_run, "run", run)
    monkeypatch.setattr(cli_run, "find_captures", find)
    monkeypatch.setattr(cli_run, "load_ahead", lambda: None)
    return result


def test_a_file_sets_options_and_the_command_line_comes_first(
    tmp_path: Path, seen: list[tuple[DiscoverOptions, Settings]]
) -> None:
    config = tmp_path / "agalign.toml"
    config.write_text(
        'radiometry = "sun"\nerror-map = true\naccept_predicted = 0.5\nindex = "ndvi,NDRE"\nexclude = ["*a*", "*b*"]\n'
        'include = "*c*"\nrng-seed = 3\n'
    )
    done = CliRunner().invoke(app, ["align", "x", "--config", str(config), "--rng-seed", "4"])
    assert done.exit_code == 0, done.output
    ((options, settings),) = seen
    assert (options.include, options.exclude) == (("*c*",), ("*a*", "*b*"))
    assert (settings.write.radiometry, settings.write.error_map, settings.write.indices) == (
        "sun",
        True,
        ("ndvi", "ndre"),
    )
    assert (settings.check.accept_predicted_px, settings.joint.rng_seed) == (0.5, 4)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('radiometri = "sun"', "no option 'radiometri'; did you mean 'radiometry'?"), ("x =", "cannot be read as TOML"),
        ('crop = "round"', "'round' is unknown; choose from flight"), ("[align]\njobs = 1", "no option 'align'"),
        ("jobs = [1, 2]", "'jobs' takes one value"), ('jobs = "many"', "--jobs: give a whole number"),
        ("dry-run = true", "no option 'dry-run'"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    config = tmp_path / "agalign.toml"
    config.write_text(text)
    done = CliRunner().invoke(app, ["align", "x", "--config", str(config)])
    assert done.exit_code == 2
    (line,) = done.stderr.splitlines()
    assert said in line


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["align", "x", "--config", str(tmp_path / "no.toml")])
    assert done.exit_code == 2
    assert f"{tmp_path / 'no.toml'} does not exist" in done.stderr


def test_the_printed_file_has_every_option_and_changes_nothing(
    tmp_path: Path, seen: list[tuple[DiscoverOptions, Settings]]
) -> None:
    text = CliRunner().invoke(app, ["info", "--options"]).stdout
    assert tomllib.loads(text) == {}
    lines = [line.removeprefix("# ") for line in text.splitlines() if " = " in line and '""' not in line]
    values = tomllib.loads("\n".join(lines))
    assert {"radiometry", "jobs", "rng-seed", "error-map", "relief", "out"} - set(values) == {"out"}
    config = tmp_path / "agalign.toml"
    config.write_text("\n".join(lines))
    assert CliRunner().invoke(app, ["align", "x"]).exit_code == 0
    done = CliRunner().invoke(app, ["align", "x", "--config", str(config)])
    assert done.exit_code == 0, done.output
    assert seen[1][1] == seen[0][1]


def test_a_dry_run_says_what_would_be_done_and_writes_nothing(tmp_path: Path) -> None:
    synthetic.make_flight(tmp_path / "in", captures=2, size_px=(160, 120))
    before = sorted(tmp_path.rglob("*"))
    done = CliRunner().invoke(app, ["align", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--dry-run", "-v"])
    assert done.exit_code == 0, done.output
    assert "2 captures to be aligned; nothing was written" in " ".join(done.stdout.split())
    assert "IMG_0002: to be aligned" in done.stderr
    assert sorted(tmp_path.rglob("*")) == before


def test_the_report_as_json(tmp_path: Path) -> None:
    make_aligned(tmp_path, 2)
    done = CliRunner().invoke(app, ["report", str(tmp_path), "--json"])
    assert done.exit_code == 0
    facts = json.loads(done.stdout)
    assert [c["label"] for c in facts["captures"]] == ["0000SET/IMG_0001", "0000SET/IMG_0002"]
