"""Options of the command line and of a file become settings; what a run would do; facts as JSON."""

import itertools
import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from synthetic_flights.aligned import make_aligned

import agalign
from agalign.cli import main
from agalign.errors import OutputError
from agalign.synthetic import flight as synthetic

from ..conftest import raising, read_json
from ..program import agalign_here


def parameters(command: str, *arguments: object) -> dict[str, Any]:
    """The values of the options of a command."""
    return main.COMMANDS[command].built().make_context(command, [*map(str, arguments)]).params


def test_a_file_sets_options_and_the_command_line_comes_first(tmp_path: Path) -> None:
    synthetic.make_flight(tmp_path / "in", captures=1, size_px=(160, 120))
    config = tmp_path / "agalign.toml"
    config.write_text(
        '\ufeffradiometry = "sun"\nqa = true\naccept_predicted = 0.5\nindex = "ndvi,NDRE"\nonly-seed = true\n'
        'exclude = ["*_1.*", "*_9.*"]\ninclude = "0000SET/*"\nrng-seed = 3\n'
    )
    done = agalign_here(tmp_path / "in", "-o", tmp_path / "out", "--config", config, "--rng-seed", "4")
    assert done.returncode == 3, done.stderr
    settings = read_json(tmp_path / "out" / "agalign-run.json")["settings"]
    write = settings["write"]
    assert (write["radiometry"], write["qa"], write["indices"]) == ("sun", True, ["ndvi", "ndre"])
    assert (settings["check"]["accept_predicted_px"], settings["joint"]["rng_seed"]) == (0.5, 4)
    bands = read_json(tmp_path / "out" / "0000SET" / "000" / "IMG_0001.json")["bands"]
    assert [band["band"] for band in bands] == ["Green", "Red", "NIR", "Red edge"]


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
        ("qa = ''", "'qa' takes true or false"),
        ("timeout = inf", "--timeout: "),
        ("out = ''", "--out: is empty; give a path"),
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


@pytest.mark.parametrize(
    ("encoding", "comment"), [("utf-16", ""), ("utf-16-le", ""), ("utf-16-be", "größer"), ("latin-1", "größer")]
)
def test_a_file_in_another_encoding_is_to_be_saved_as_utf_8(tmp_path: Path, encoding: str, comment: str) -> None:
    """PowerShell 5 writes UTF-16 where it redirects output."""
    config = tmp_path / "agalign.toml"
    config.write_bytes(f'# {comment}\r\nreference = "Red"\r\n'.encode(encoding))
    done = agalign_here("align", "x", "--config", config)
    (line,) = done.stderr.splitlines()
    assert (done.returncode, f"{config} is not in UTF-8; save it as UTF-8" in line) == (2, True)


@pytest.mark.full
def test_any_value_of_any_option_is_taken_or_one_line(tmp_path: Path) -> None:
    synthetic.make_flight(tmp_path / "in", captures=1, size_px=(32, 24))
    config = tmp_path / "agalign.toml"
    values = ["true", "0", "-1", "1.5", "nan", "-inf", "1e308", str(2**62), "[]", "[[1]]", '["a", 1]', "07:32:00"]
    values += ['""', '"x"', r'"\u001b[2J\u202e"', '"../../pwn"', '"/dev/zero"', r'"\u0000"', f'"{"x" * 9999}"']
    parameters = main.COMMANDS["align"].built().params
    options = [max(p.opts, key=len).lstrip("-") for p in parameters if p.param_type_name == "option"]
    for option, value in itertools.product(options, values):
        config.write_text(f"{option} = {value}")
        done = agalign_here("align", tmp_path / "in", "--config", config, "--dry-run")
        assert done.returncode in (0, 1, 2), config.read_text()
        assert (done.stdout + done.stderr).replace("\n", "").isprintable(), config.read_text()
        assert "please report" not in done.stderr, config.read_text()
    assert set(tmp_path.iterdir()) == {config, tmp_path / "in"}


@pytest.mark.parametrize("value", [True, False])
def test_true_and_false_are_those_of_python(value: bool, tmp_path: Path) -> None:
    config = tmp_path / "agalign.toml"
    config.write_text(f"radiometry = {str(value).lower()}\nrelief = {str(value).lower()}\n")
    of_file = parameters("align", "x", "--config", config)
    in_python = agalign.WriteSettings(radiometry=value).radiometry, agalign.ReliefSettings(use=value).use
    assert (of_file["radiometry"], of_file["relief"]) == in_python
    if value:
        alone = parameters("align", "x", "--radiometry", "--relief")
        assert (alone["radiometry"], alone["relief"]) == in_python


def test_the_printed_file_has_every_option_and_changes_nothing(tmp_path: Path) -> None:
    text = agalign_here("info", "--options").stdout
    assert tomllib.loads(text) == {}
    lines = [line.removeprefix("# ") for line in text.splitlines() if " = " in line and '""' not in line]
    values = tomllib.loads("\n".join(lines))
    assert {"radiometry", "jobs", "rng-seed", "error-map", "relief", "out"} - set(values) == {"out"}
    config = tmp_path / "agalign.toml"
    config.write_text("\n".join(lines))
    assert parameters("align", "x", "--config", config) == parameters("align", "x") | {"config": config}


@pytest.mark.parametrize(
    ("arguments", "relief"),
    [
        ("align flight", "auto"),
        ("align flight --relief", "always"),
        ("align flight --relief -q", "always"),
        ("align flight --relief never", "never"),
        ("align flight --relief=never", "never"),
        ("align flight --relief --relief-map --fill-occluded", "always"),
        ("align --relief flight", "always"),
        ("onto a.tif b.tif --relief", "always"),
    ],
)
def test_relief_without_a_value_is_always(
    arguments: str, relief: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flight").mkdir()  # a folder after --relief is not its value
    values = parameters(*arguments.split())
    assert values["relief"] == relief
    assert values.get("folder", Path("flight")) == Path("flight")


def test_a_dry_run_prints_its_plan_and_writes_nothing(flight: Path, tmp_path: Path) -> None:
    command = "align", flight, "-o", tmp_path / "out", "--index", "ndvi", "--dry-run", "-v"
    done = agalign_here(*command)
    assert done.returncode == 0, done.stderr
    assert "2 captures to be aligned; nothing was written" in " ".join(done.stdout.split())
    assert "IMG_0002: to be aligned" in done.stderr
    assert "raw numbers, not reflectance" in done.stderr
    assert "raw numbers" not in agalign_here(*command, "--radiometry", "auto").stderr
    assert not any(tmp_path.iterdir())


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


def test_indices_are_printed_if_their_table_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_aligned(tmp_path, 1)
    full = OutputError(f"{tmp_path / 'indices.csv'}: cannot be written (No space left on device)")
    monkeypatch.setattr("agalign.batch.index_run.update_table", raising(full))
    done = agalign_here("indices", tmp_path, "--json")
    assert (done.returncode, done.stderr) == (3, f"agalign: {full}\n")
    assert [one["index"] for one in json.loads(done.stdout)["indices"]] == ["ndvi"]
