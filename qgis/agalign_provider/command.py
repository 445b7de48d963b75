"""The command line of agalign in a process of its own: found, run, followed and cancelled.

Nothing here needs QGIS. QGIS's own Python need not have agalign or PyTorch.
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

_SECONDS_TO_END = 15
"""For the program to finish the files that it is writing, once it is asked to end."""
_POLL_S = 0.2
_OF_QGIS = (
    "PYTHONHOME", "PYTHONPATH", "PYTHONEXECUTABLE", "PYTHONUSERBASE", "GDAL_DATA", "GDAL_DRIVER_PATH", "PROJ_LIB",
    "PROJ_DATA", "LD_LIBRARY_PATH", "LD_PRELOAD", "DYLD_LIBRARY_PATH", "DYLD_INSERT_LIBRARIES",
)  # fmt: skip
"""Variables that QGIS sets for its own libraries, which differ from those that agalign brings."""
EXIT_OK, EXIT_PARTIAL = 0, 3


class CommandError(Exception):
    """The program is missing, or ended with an error; the text is for the user."""


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
        "agalign is not installed where QGIS can find it; install it (pipx install agalign), or name its executable "
        "under Settings, Options, Processing, Providers, agalign"
    )


def environment():
    """Variables for the process: those of QGIS's own libraries are left out."""
    return {k: v for k, v in os.environ.items() if k not in _OF_QGIS}


class Command:
    """A run of agalign. `is_canceled()` is polled; `on_event(dict)` gets each line of `--log-json`, and a line that is
    not JSON as the event `text`.
    """

    def __init__(self, arguments, is_canceled, on_event):
        self.arguments = [str(a) for a in arguments]
        self._is_canceled, self._on_event = is_canceled, on_event
        self._lines = queue.Queue()
        self.problems = []
        self.output = ""

    def run(self):
        """Return the exit code, 0 or 3 (some captures are not aligned); None where it was cancelled.

        Raises CommandError where it cannot be started or fails.
        """
        try:
            process = subprocess.Popen(
                self.arguments, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                env=environment(), encoding="utf-8", errors="replace", **_own_group(),
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
            reader.join(timeout=_SECONDS_TO_END)
        self._deliver()
        if canceled:
            return None
        if process.returncode not in (EXIT_OK, EXIT_PARTIAL):
            why = self.problems[-1] if self.problems else f"exit code {process.returncode}"
            raise CommandError(f"agalign: {why}")
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


def _own_group():
    """The process and its workers can be ended together, and a key pressed in QGIS's terminal does not reach them."""
    if os.name == "nt":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
    return {"start_new_session": True}


def _end(process):
    """Ask the process group to end; end it by force where it does not."""
    if os.name == "nt":
        subprocess.run(["taskkill", "/T", "/F", "/PID", str(process.pid)], capture_output=True, check=False)
        process.wait()
        return
    _signal_group(process.pid, signal.SIGTERM)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=_SECONDS_TO_END)
    # Also workers that outlive the program.
    _signal_group(process.pid, signal.SIGKILL)
    process.wait()


def _signal_group(group, number):
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, number)
