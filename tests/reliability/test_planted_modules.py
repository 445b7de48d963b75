"""Python files in the working folder that have the names of modules: no process of a command runs them."""

import os
import subprocess
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest

from agalign.cameras.read_files import _MIN_FILES_FOR_PROCESSES
from agalign.synthetic import flight as synthetic

from ..conftest import Shared

pytestmark = [pytest.mark.slow, pytest.mark.full]

CONSOLE_SCRIPT = [str(Path(sys.executable).with_name("agalign"))]
MODULE = [sys.executable, "-m", "agalign"]
RUN = "-j", "2", "--bands", "green,nir", "--relief", "never", "-o", "out"
INFO = ("info",)
Names = Callable[[tuple[str, ...]], set[str]]
NAMES_OF_A_RUN = """
import atexit, sys
atexit.register(lambda: print(*sys.modules))
if __name__ == "__main__":
    from agalign.__main__ import main
    main()
"""
SCRIPT = """
import sys
import agalign
import helper_of_script
if __name__ == "__main__":
    settings = agalign.Settings(seed={"only": True})
    reports = agalign.align_folder(sys.argv[1], sys.argv[2], settings=settings, run=agalign.RunOptions(jobs=2))
    print(len(reports))
"""


def output(*command: object, folder: Path | None = None) -> str:
    """Run a command in a folder; return its standard output."""
    return subprocess.run([*map(str, command)], cwd=folder, stdout=subprocess.PIPE, text=True, check=True).stdout


def modules(printed: str) -> set[str]:
    return {name.partition(".")[0] for name in printed.splitlines()[-1].split()}


@pytest.fixture(scope="module")
def four_captures(shared: Shared) -> Path:
    """So many that two worker processes are started."""
    return shared("four_captures", lambda folder: synthetic.make_flight(folder, captures=4, size_px=(240, 180)))


@pytest.fixture(scope="module")
def names(shared: Shared, four_captures: Path) -> Names:
    """Call with the arguments of a command: the names of all modules that it imports, without packages' names."""

    def of(arguments: tuple[str, ...]) -> set[str]:
        def list_modules(folder: Path) -> None:
            (folder / "script.py").write_text(NAMES_OF_A_RUN)
            command = sys.executable, folder / "script.py", *arguments, four_captures
            (folder / "names").write_text(output(*command, folder=folder))

        return modules((shared(f"names_{len(arguments)}", list_modules) / "names").read_text())

    return of


def plant(names: set[str], folder: Path) -> Path:
    """Make a folder with a Python file for each name, which writes the name to the returned log."""
    folder.mkdir()
    log = folder.parent / "planted.log"
    for name in names:
        (folder / f"{name}.py").write_text(f"open({str(log)!r}, 'a').write({name + ' '!r})\n")
    return log


@pytest.mark.parametrize(("command", "arguments"), [(MODULE, INFO), (CONSOLE_SCRIPT, RUN), (MODULE, RUN)])
def test_no_module_is_imported_from_the_working_folder(
    command: list[str], arguments: tuple[str, ...], names: Names, four_captures: Path, tmp_path: Path
) -> None:
    imported = names(arguments)
    if command == MODULE:  # Python itself imports these from there, before any code of the package
        imported -= modules(output(sys.executable, "-c", "import runpy, sys; print('agalign', *sys.modules)"))
    assert {"rasterio", "click", "typing", "socket", "multiprocessing"} <= imported
    folder = tmp_path / "working folder"
    log = plant(imported, folder)
    for path, k in product(four_captures.rglob("*.tif"), range(_MIN_FILES_FOR_PROCESSES // 20)):
        os.link(path, folder / f"{k}{path.name}")
    output(*command, *arguments, four_captures if arguments == RUN else ".", folder=folder)
    assert not log.exists(), log.read_text()


def test_workers_of_a_script_import_what_the_script_imports(names: Names, four_captures: Path, tmp_path: Path) -> None:
    """From the folder of the script, but nothing from the working folder."""
    log, script = plant(names(RUN), tmp_path / "working folder"), tmp_path / "script" / "script.py"
    script.parent.mkdir()
    (script.parent / "helper_of_script.py").touch()
    script.write_text(SCRIPT)
    printed = output(sys.executable, script, four_captures, tmp_path / "out", folder=tmp_path / "working folder")
    assert printed == "4\n"
    assert not log.exists(), log.read_text()
