"""Options of the command line and of a file become settings; what a run would do; facts as JSON."""

import itertools
import json
import tomllib
from pathlib import Path

import pytest
from synthetic_flights.aligned import make_aligned

import agalign
from agalign.cli import align_commands as cli_align
from agalign.cli import align_run as cli_run
from agalign.cli import main
from agalign.synthetic import flight as synthetic

from ..program import agalign_here

Seen = list[tuple[agalign.DiscoverOptions, agalign.Settings]]


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Seen:
    """The options and settings that the command makes of its arguments."""
    result: Seen = []
    found: list[agalign.DiscoverOptions] = []

    def find(folder: Path, options: agalign.DiscoverOptions, *_: object) -> agalign.FolderScan:
        found.append(options)
        return agalign.FolderScan(folder, (), ())

    def run(_flight: object, _out: Path, settings: agalign.Settings, *_: object, **__: object) -> None:
        result.append((found.pop(), settings))
        raise SystemExit(0)

    monkeypatch.setattr(cli_run, "find_captures", find)
    monkeypatch.setattr(cli_run, "run", run)
    monkeypatch.setattr(cli_align, "load_ahead", lambda: None)
    return result


def test_a_file_sets_options_and_the_command_line_comes_first(tmp_path: Path, seen: Seen) -> None:
    config = tmp_path / "agalign.toml"
    config.write_text(
        '\ufeffradiometry = "sun"\nerror-map = true\naccept_predicted = 0.5\nindex = "ndvi,NDRE"\n'
        'exclude = ["*a*", "*b*"]\ninclude = "*c*"\nrng-seed = 3\n'
    )
    done = agalign_here("align", "x", "--config", config, "--rng-seed", "4")
    assert done.returncode == 0, done.stderr
    ((options, settings),) = seen
    assert (options.include, options.exclude) == (("*c*",), ("*a*", "*b*"))
    write = settings.write
    assert (write.radiometry, write.error_map, write.indices) == ("sun", True, ("ndvi", "ndre"))
    assert (settings.check.accept_predicted_px, settings.joint.rng_seed) == (0.5, 4)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('radiometri = "sun"', "no option 'radiometri' (did you mean 'radiometry'?)"),
        ("x =", "cannot be read as TOML"),
        ('crop = "round"', "'round' is unknown; choose from flight"),
        ("[align]\njobs = 1", "no option 'align'"),
        ("jobs = [1, 2]", "'jobs' takes one value"),
        ("jobs = {a = 1}", "'jobs' takes one value"),
        ("jobs = true", "'jobs' takes a text or number"),
        ("exclude = [true]", "'exclude' takes a text or number"),
        ("out = 1979-05-27", "'out' takes a text or number"),
        ("stac = ''", "'stac' takes true or false"),
        ("timeout = inf", "--timeout: "),
        ("ground-elevation = nan", "--ground-elevation: "),
        (f"jobs = {2**63}", "--jobs: "),
        ("x = " + "[" * 9999 + "]" * 9999, "cannot be read as TOML"),
        ("x = " + "9" * 9999, "cannot be read as TOML"),
        ('jobs = "many"', "--jobs: give a whole number"),
        ('index = "nope"', "unknown index 'nope'"),
        ("dry-run = true", "no option 'dry-run'"),
        (None, "agalign.toml does not exist"),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path: Path, text: str | None, said: str) -> None:
    config = tmp_path / "agalign.toml"
    if text is not None:
        config.write_text(text)
    done = agalign_here("align", "x", "--config", config)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert said in line
    assert str(config) in line


@pytest.mark.full
def test_any_value_of_any_option_is_taken_or_one_line(tmp_path: Path) -> None:
    synthetic.make_flight(tmp_path / "in", captures=1, size_px=(32, 24))
    config = tmp_path / "agalign.toml"
    values = ["true", "0", "-1", "1.5", "nan", "-inf", "1e308", str(2**62), "[]", "[[1]]", '["a", 1]', "07:32:00"]
    values += ['""', '"x"', r'"\u001b[2J\u202e"', '"../../pwn"', '"/dev/zero"', r'"\u0000"', f'"{"x" * 9999}"']
    parameters = main.COMMANDS["align"].built("align").params
    options = [max(p.opts, key=len).lstrip("-") for p in parameters if p.param_type_name == "option"]
    for option, value in itertools.product(options, values):
        config.write_text(f"{option} = {value}")
        done = agalign_here("align", tmp_path / "in", "--config", config, "--dry-run")
        assert done.returncode in (0, 1, 2), config.read_text()
        assert (done.stdout + done.stderr).replace("\n", "").isprintable(), config.read_text()
        assert "please report" not in done.stderr, config.read_text()
    assert set(tmp_path.iterdir()) == {config, tmp_path / "in"}


def test_the_printed_file_has_every_option_and_changes_nothing(tmp_path: Path, seen: Seen) -> None:
    text = agalign_here("info", "--options").stdout
    assert tomllib.loads(text) == {}
    lines = [line.removeprefix("# ") for line in text.splitlines() if " = " in line and '""' not in line]
    values = tomllib.loads("\n".join(lines))
    assert {"radiometry", "jobs", "rng-seed", "error-map", "relief", "out"} - set(values) == {"out"}
    config = tmp_path / "agalign.toml"
    config.write_text("\n".join(lines))
    assert agalign_here("align", "x").returncode == 0
    done = agalign_here("align", "x", "--config", config)
    assert done.returncode == 0, done.stderr
    assert seen[1][1] == seen[0][1]


@pytest.mark.parametrize(
    ("arguments", "chosen"),
    [
        ("", ("auto", False, False)),
        ("--relief", ("always", False, False)),
        ("--relief -q", ("always", False, False)),
        ("--relief never", ("never", False, False)),
        ("--relief=never", ("never", False, False)),
        ("--relief --relief-map --fill-occluded", ("always", True, True)),
        ("--local -q", ("always", False, False)),
        ("--local=never", ("never", False, False)),
    ],
)
def test_relief_is_always_and_local_its_old_name(arguments: str, chosen: tuple[str, bool, bool], seen: Seen) -> None:
    for command in ([], ["align"]):
        done = agalign_here(*command, "flight", *arguments.split())
        _, settings = seen.pop()
        assert (settings.relief.use, settings.write.relief_map, settings.write.fill_occluded) == chosen
        assert ("--local is deprecated; use --relief" in done.stderr) == ("--local" in arguments)


def test_local_is_the_old_name_of_relief_for_onto_too() -> None:
    context = main.COMMANDS["onto"].built("onto").make_context("onto", ["a.tif", "b.tif", "--local"])
    assert context.params["relief"] == "always"


def test_a_folder_after_relief_is_no_choice_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flight").mkdir()
    context = main.COMMANDS["align"].built("align").make_context("align", ["--relief", "flight"])
    assert (context.params["relief"], context.params["folder"]) == ("always", Path("flight"))


def test_a_dry_run_prints_its_plan_and_writes_nothing(tmp_path: Path) -> None:
    synthetic.make_flight(tmp_path / "in", captures=2, size_px=(160, 120))
    before = sorted(tmp_path.rglob("*"))
    done = agalign_here("align", tmp_path / "in", "-o", tmp_path / "out", "--dry-run", "-v")
    assert done.returncode == 0, done.stderr
    assert "2 captures to be aligned; nothing was written" in " ".join(done.stdout.split())
    assert "IMG_0002: to be aligned" in done.stderr
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["indices", "ndvi"])
def test_indices_are_written_and_summed_up(tmp_path: Path, name: str) -> None:
    make_aligned(tmp_path, 2)
    done = agalign_here(name, tmp_path, "--index", "ndvi,NDRE", "--formula", "x=N/R")
    assert done.returncode == 0, done.stderr
    assert "6 of 6 written" in done.stdout
    assert done.stderr == ""
    assert len(list(tmp_path.rglob("*_x.tif"))) == len(list(tmp_path.rglob("*_ndre.png"))) == 2


def test_raw_numbers_are_announced_first(tmp_path: Path) -> None:
    make_aligned(tmp_path, 1, raw=True)
    done = agalign_here("indices", tmp_path, "-v")
    first, second = done.stderr.splitlines()
    assert "raw numbers, not reflectance" in first
    assert "--radiometry auto" in first
    assert "IMG_0001 ndvi: median" in second
    assert agalign_here("indices", tmp_path, "--index", "savi").returncode == 1


def test_reports_as_json(tmp_path: Path) -> None:
    make_aligned(tmp_path, 1)
    done = agalign_here("indices", tmp_path, "--index", "ndvi,evi", "--json")
    assert done.returncode == 3, "there is no blue band"
    ndvi, evi = json.loads(done.stdout)["indices"]
    assert (ndvi["capture"], ndvi["unit"], ndvi["problem"]) == ("0000SET/IMG_0001", "reflectance", None)
    assert ndvi["p5"] < ndvi["median"] < ndvi["p95"]
    assert (evi["path"], evi["median"]) == (None, None)
    assert "evi needs a blue band" in evi["problem"]


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ("--index xyz", "unknown index 'xyz'"),
        ("--formula import", "is not a formula"),
        ("--index ndvi,ndvi", "'ndvi' is given twice"),
        ("--index ,", "--index is empty"),
        ("--formula N/R --formula N/G", "'formula' is given twice"),
    ],
)
def test_wrong_indices_are_one_line(tmp_path: Path, options: str, problem: str) -> None:
    make_aligned(tmp_path, 1)
    done = agalign_here("indices", tmp_path, *options.split())
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert problem in line


def test_a_run_announces_indices_of_raw_numbers_too(tmp_path: Path) -> None:
    synthetic.make_flight(tmp_path / "in", captures=1, size_px=(160, 120))
    said = [
        agalign_here("align", tmp_path / "in", "--index", "ndvi", "--dry-run", *options).stderr
        for options in ([], ["--radiometry", "auto"])
    ]
    assert ["raw numbers, not reflectance" in text for text in said] == [True, False]
