"""Find, run, monitor and cancel the command line of agalign in a separate process.

This module does not import QGIS, and the Python of QGIS does not need agalign or PyTorch.
"""

import contextlib
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

_TERMINATION_TIMEOUT_S = 15
"""Time between SIGTERM and SIGKILL, in which agalign finishes the files that it is writing."""
_POLL_S = 0.2
_QGIS_VARIABLES = (
    "PYTHONHOME", "PYTHONPATH", "PYTHONEXECUTABLE", "PYTHONUSERBASE", "GDAL_DATA", "GDAL_DRIVER_PATH", "PROJ_LIB",
    "PROJ_DATA", "LD_LIBRARY_PATH", "LD_PRELOAD", "DYLD_LIBRARY_PATH", "DYLD_INSERT_LIBRARIES",
)  # fmt: skip
"""Environment variables that QGIS sets for its libraries, which differ from those of agalign."""
EXIT_OK, EXIT_PARTIAL = 0, 3


class CommandError(Exception):
    """agalign is not installed, or ended with an error; the text is for the user."""


def find_executable(setting=""):
    """Return the path of agalign: that of the setting (a file, or the folder of a virtual environment), or else on
    PATH, in the active virtual environment, next to this Python, or where pipx and uv install. Raises CommandError.
    """
    name = "agalign.exe" if os.name == "nt" else "agalign"
    if setting:
        given = Path(setting).expanduser()
        for path in (given, given / "bin" / name, given / "Scripts" / name):
            if path.is_file():
                return str(path)
        raise CommandError(
            f"{setting}: no executable of agalign; correct it under Settings, Options, Processing, Providers, agalign"
        )
    on_path = shutil.which("agalign")
    if on_path:
        return on_path
    folders = [Path(sys.executable).parent, Path.home() / ".local" / "bin"]
    if os.environ.get("VIRTUAL_ENV"):
        folders[:0] = [Path(os.environ["VIRTUAL_ENV"]) / sub for sub in ("bin", "Scripts")]
    for folder in folders:
        if (folder / name).is_file():
            return str(folder / name)
    raise CommandError(
        "agalign is not installed where QGIS can find it; install it (pipx install PATH, with the "
        "path of a checkout or wheel of agalign), or name its executable "
        "under Settings, Options, Processing, Providers, agalign"
    )


def environment():
    """Return the environment variables without those for the libraries of QGIS."""
    return {k: v for k, v in os.environ.items() if k not in _QGIS_VARIABLES}


def sidecars_below(folder):
    """Return (path, content) of every sidecar below a folder, sorted."""
    result = []
    for path in sorted(folder.rglob("*.json")):
        try:
            # Reading a pipe would block, and deep nesting is a RecursionError.
            content = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
        except (OSError, ValueError, RecursionError):
            continue
        if isinstance(content, dict) and str(content.get("schema", "")).startswith("agalign/") and "status" in content:
            result.append((path, content))
    return result


class Command:
    """A run of agalign. `is_canceled()` is polled; `on_event(dict)` is called with each line of `--log-json`, and with
    other lines as the event `text`.
    """

    def __init__(self, arguments, is_canceled, on_event):
        self.arguments = [str(a) for a in arguments]
        self._is_canceled, self._on_event = is_canceled, on_event
        self._lines = queue.Queue()
        self.problems = []
        self.output = ""

    def run(self):
        """Return the exit code, 0 or 3 (some captures are not aligned); None if it was cancelled.

        Raises CommandError if it cannot be started or fails.
        """
        try:
            process = subprocess.Popen(
                self.arguments, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                env=environment(), encoding="utf-8", errors="replace", **_new_process_group(),
            )  # fmt: skip
        except OSError as error:
            raise CommandError(f"{self.arguments[0]}: cannot be started ({error.strerror or error})") from None
        readers = [
            threading.Thread(target=self._read, args=(stream, name), daemon=True)
            for stream, name in ((process.stdout, "output"), (process.stderr, "event"))
        ]
        for reader in readers:
            reader.start()
        canceled = False
        while process.poll() is None:
            self._deliver(wait_s=_POLL_S)
            if self._is_canceled():
                canceled = True
                _end(process)
                break
        for reader in readers:
            reader.join(timeout=_TERMINATION_TIMEOUT_S)
        self._deliver()
        if canceled:
            return None
        if process.returncode not in (EXIT_OK, EXIT_PARTIAL):
            reason = self.problems[-1] if self.problems else f"exit code {process.returncode}"
            raise CommandError(f"agalign: {reason}")
        return process.returncode

    def _read(self, stream, name):
        with stream:
            for line in stream:
                self._lines.put((name, line))

    def _deliver(self, wait_s=0.0):
        while True:
            try:
                name, line = self._lines.get(timeout=wait_s) if wait_s else self._lines.get_nowait()
            except queue.Empty:
                return
            wait_s = 0.0
            if name == "output":
                self.output += line
                continue
            event = _event(line)
            if event["event"] == "problem":
                self.problems.append(event.get("message", ""))
            self._on_event(event)


def _event(line):
    try:
        event = json.loads(line)
        if isinstance(event, dict) and "event" in event:
            return event
    except ValueError:
        pass
    return {"event": "text", "message": line.rstrip()}


def _new_process_group():
    """Return options of Popen for a new process group, which is ended as a whole and does not receive Ctrl+C."""
    if os.name == "nt":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
    return {"start_new_session": True}


def _end(process):
    """Terminate the process group, and kill it if it does not end in time."""
    if os.name == "nt":
        subprocess.run(["taskkill", "/T", "/F", "/PID", str(process.pid)], capture_output=True, check=False)
        process.wait()
        return
    _signal_group(process.pid, signal.SIGTERM)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=_TERMINATION_TIMEOUT_S)
    # Also kills workers that still run.
    _signal_group(process.pid, signal.SIGKILL)
    process.wait()


def _signal_group(group, number):
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, number)
