"""What can be wrong with a card, a disk, a machine or a file, and what the program must make of it.

Each fault is done to a small flight of two good captures, `a` and `b`, and the program is run on it. `python -m
tests.reliability.faults --markdown docs/reliability.md` writes the table of docs/reliability.md from what is seen;
test_faults.py holds each fault to what is written here.
"""

import contextlib
import ctypes
import errno
import fcntl
import os
import re
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import tifffile

from agalign.cli import run as cli_run
from agalign.errors import SidecarError
from agalign.products.sidecar_file import find_sidecars, read_sidecar
from agalign.values.files import RUN_FILE

from ..conftest import textured_pair
from ..program import agalign_here

SHIFT = np.array([[1, 0, 6.0], [0, 1, -4.0], [0, 0, 1]])
SIZE_PX = 320, 240
MANY = 12
"""Captures of a run that something happens to."""
ALL = tuple("abcdefghijkl")
"""Their names."""
XMP = 700
STRANGE_NAMES = "with space é 雨", "-rf", "quote'\"`$(x)", "new\nline", "\x1b[31mred\a", "_", "x" * 200
_PACKET = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:Camera="http://pix4d.com/camera/1.0/" xmlns:MicaSense="http://micasense.com/MicaSense/1.0/"'
    ' xmlns:DLS="http://micasense.com/DLS/1.0/">{}</rdf:Description></rdf:RDF></x:xmpmeta>'
)


@dataclass
class Scene:
    """A flight of two good captures, and how the program is to be run on it."""

    folder: Path
    out: Path
    arguments: list[str] = field(default_factory=list)
    command: list[str] | None = None
    """Instead of aligning the folder into `out`."""
    during: Callable[[], None] | None = None
    """Done when the captures are found."""
    watch: Callable[["subprocess.Popen[str]"], None] | None = None
    """Done beside the program, which then has a process of its own."""
    process: dict[str, Any] = field(default_factory=dict)
    """How that process is started, where it must have one."""
    undo: Callable[[], None] = lambda: None
    children: list[psutil.Process] = field(default_factory=list)
    """Processes that must not outlive the program."""

    def file(self, name: str = "b_nir.tif") -> Path:
        return self.folder / name


@dataclass(frozen=True)
class Fault:
    """Something that is wrong."""

    name: str
    spoil: Callable[[Scene], None]
    code: int
    says: str = ""
    """A pattern of one of the complaints; nothing is to be complained of where it is empty."""
    finished: tuple[str, ...] = ("a",)
    """Captures that must be aligned all the same."""
    all_but: int | None = None
    """So many of the twelve captures of a longer run are lost, whichever."""


@dataclass(frozen=True)
class Seen:
    """What came of a fault."""

    code: int
    complaints: list[str]
    finished: list[str]
    output: str
    seconds: float


# ---- running


def make_flight(folder: Path, names: str = "ab") -> None:
    """A capture of two bands for each letter."""
    folder.mkdir(parents=True)
    for number, name in enumerate(names):
        write_capture(folder, name, number)


def write_capture(folder: Path, name: str, number: int = 0, suffix: str = ".tif") -> None:
    for band, image in zip(("green", "nir"), images(number), strict=True):
        tifffile.imwrite(folder / f"{name}_{band}{suffix}", image)


@cache
def images(number: int) -> tuple[np.ndarray, ...]:
    """The two bands of the capture of this number."""
    return tuple(map(as_numbers, textured_pair(SHIFT, *SIZE_PX, seed=number)))


def as_numbers(image: np.ndarray) -> np.ndarray:
    return ((image - image.min()) / np.ptp(image) * 60000 + 1000).astype(np.uint16)


def run_fault(fault: Fault, folder: Path) -> Seen:
    """Make a flight, do the fault to it, run the program."""
    scene = Scene(folder / "flight", folder / "out")
    make_flight(scene.folder)
    fault.spoil(scene)
    command = scene.command or [str(scene.folder), "-o", str(scene.out), "-j", "1"]
    began = time.monotonic()
    try:
        run = run_outside if scene.watch or scene.process else run_inside
        code, output = run([*command, *scene.arguments], scene)
        whole = aligned(scene.out)
    finally:
        scene.undo()
    complaints = [line.removeprefix("agalign: ") for line in output.splitlines() if line.startswith("agalign: ")]
    return Seen(code, complaints, whole, output, time.monotonic() - began)


def aligned(out: Path) -> list[str]:
    """Captures all of whose bands are aligned."""
    result = []
    for path in find_sidecars(out) if out.is_dir() else []:
        with contextlib.suppress(SidecarError):
            sidecar = read_sidecar(path)
            result += [sidecar.capture] if sidecar.status == "ok" else []
    return result


def run_inside(arguments: list[str], scene: Scene) -> tuple[int, str]:
    """In this process, which has loaded everything: (exit code, standard error)."""
    real = cli_run.find_captures

    def result(*given: Any, **named: Any) -> Any:
        flight = real(*given, **named)
        if scene.during is not None:
            scene.during()
        return flight

    homes = [module for module in list(sys.modules.values()) if getattr(module, "find_captures", None) is real]
    for home in homes:
        home.find_captures = result  # type: ignore[attr-defined]
    try:
        done = agalign_here(*arguments)
    finally:
        for home in homes:
            home.find_captures = real  # type: ignore[attr-defined]
    return done.returncode, done.stderr


def run_outside(arguments: list[str], scene: Scene) -> tuple[int, str]:
    """In a process of its own: (exit code, standard error)."""
    given = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    given |= scene.process
    with subprocess.Popen([sys.executable, "-m", "agalign", *arguments], **given) as process:
        if scene.watch is not None:
            scene.watch(process)
        _, errors = process.communicate(timeout=200)
    _, left = psutil.wait_procs(scene.children, timeout=20)
    return process.returncode, (errors or "") + "".join(f"agalign: left behind: {p}\n" for p in left)


# ---- what is done to files


def edited(change: Callable[[bytes], bytes]) -> Callable[[Scene], None]:
    def spoil(scene: Scene) -> None:
        path = scene.file()
        path.write_bytes(change(path.read_bytes()))

    return spoil


def extra(name: str, data: bytes) -> Callable[[Scene], None]:
    return lambda scene: (scene.folder / name).write_bytes(data) and None


def tagged(packet: str | None = None, **tags: Any) -> Callable[[Scene], None]:
    """Both files of b with tags; a packet's values stand in `_PACKET`."""

    def spoil(scene: Scene) -> None:
        for name in ("b_green.tif", "b_nir.tif"):
            path = scene.file(name)
            image = tifffile.imread(path)
            data = None if packet is None else packet.encode()
            more = [] if data is None else [(XMP, 1, len(data), data, True)]
            tifffile.imwrite(path, image, extratags=[*more, *tags.get("extratags", [])])

    return spoil


def xmp(values: str) -> Callable[[Scene], None]:
    return tagged(_PACKET.format(values))


def directory_of(entries: list[tuple[int, int, int, bytes]], more: bytes = b"") -> bytes:
    """A little-endian TIFF of (tag, type, count, value or place), and what follows."""
    body = b"".join(struct.pack("<HHI", *head) + value.ljust(4, b"\0") for *head, value in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + struct.pack("<I", 0) + more


def number(value: int) -> bytes:
    return struct.pack("<I", value)


def image_of(width: int, height: int, bands: int = 1) -> list[tuple[int, int, int, bytes]]:
    """The tags of an image that has no pixels."""
    return [
        (256, 4, 1, number(width)), (257, 4, 1, number(height)), (258, 3, 1, number(8)), (259, 3, 1, number(1)),
        (262, 3, 1, number(1)), (273, 4, 1, number(8)), (277, 3, 1, number(bands)), (278, 4, 1, number(height)),
        (279, 4, 1, number(1)), (284, 3, 1, number(2 if bands > 1 else 1)),
    ]  # fmt: skip


def declared(width: int, height: int, bands: int = 1) -> bytes:
    return directory_of(image_of(width, height, bands))


def enormous(scene: Scene) -> None:
    for band in ("green", "nir"):
        (scene.folder / f"c_{band}.tif").write_bytes(declared(100_000, 100_000))


def long_tags(scene: Scene) -> None:
    """A thousand tags, all of the same two megabytes."""
    place = 8 + 2 + 1010 * 12 + 4
    entries = [(30_000 + k, 1, 2 << 20, number(place)) for k in range(1000)]
    scene.file().write_bytes(directory_of([*image_of(64, 64), *entries], bytes(2 << 20)))


def vrt(scene: Scene) -> str:
    """What would read another file, or ask a server, were it believed."""
    return (
        f'<VRTDataset rasterXSize="{SIZE_PX[0]}" rasterYSize="{SIZE_PX[1]}"><VRTRasterBand dataType="UInt16" band="1">'
        f"<SimpleSource><SourceFilename>{scene.file('a_nir.tif')}</SourceFilename><SourceBand>1</SourceBand>"
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )


def overviews_elsewhere(scene: Scene) -> None:
    for name in ("b_green.tif.ovr", "b_nir.tif.msk", "b_nir.tif.ovr"):
        (scene.folder / name).write_text(vrt(scene))


def of_other_size(scene: Scene) -> None:
    path = scene.file()
    tifffile.imwrite(path, tifffile.imread(path)[::2, ::2])


def of_one_pixel(scene: Scene) -> None:
    for band in ("green", "nir"):
        tifffile.imwrite(scene.file(f"b_{band}.tif"), np.ones((1, 1), np.uint16))


def all_nodata(scene: Scene) -> None:
    path = scene.file()
    blank = np.zeros_like(tifffile.imread(path))
    tifffile.imwrite(path, blank, extratags=[(42113, 2, 2, "0", True)])


def strange_names(scene: Scene) -> None:
    for place, name in enumerate(STRANGE_NAMES):
        write_capture(scene.folder, name, place)


def formulas(scene: Scene) -> None:
    write_capture(scene.folder, '=HYPERLINK("a")', 3)


def loops(scene: Scene) -> None:
    (scene.folder / "loop").symlink_to(scene.folder)
    (scene.folder / "b_nir2.tif").symlink_to(scene.folder / "b_nir2.tif")


def forbidden(path: Callable[[Scene], Path], name: str = "") -> Callable[[Scene], None]:
    """A file or folder that whoever runs the program may not read."""

    def spoil(scene: Scene) -> None:
        target = path(scene)
        if name:
            target.mkdir()
        target.chmod(0)
        scene.process = {"preexec_fn": obey_permissions}
        scene.undo = lambda: target.chmod(0o755)

    return spoil


def obey_permissions() -> None:
    """Root passes over permissions by two capabilities, which the program is started without."""
    libc = ctypes.CDLL(None)
    for capability in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
        libc.prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP


def read_only(scene: Scene) -> None:
    for one in (*scene.folder.iterdir(), scene.folder):
        one.chmod(0o555 if one.is_dir() else 0o444)
    scene.process = {"preexec_fn": obey_permissions}
    scene.undo = lambda: scene.folder.chmod(0o755)


def out_is_read_only(scene: Scene) -> None:
    scene.out.mkdir()
    scene.out.chmod(0o555)
    scene.process = {"preexec_fn": obey_permissions}


# ---- what is done to runs


def first_run(scene: Scene) -> None:
    code, output = run_inside([str(scene.folder), "-o", str(scene.out), "-j", "1"], scene)
    assert code == 0, output


def killed_inside_the_input(scene: Scene) -> None:
    """An earlier run wrote below its input, and was killed before its report."""
    earlier = scene.folder / "earlier"
    code, _ = run_inside([str(scene.folder), "-o", str(earlier), "-j", "1"], scene)
    assert code == 0
    for name in ("summary.csv", "index.html"):
        (earlier / name).unlink()
    assert (earlier / RUN_FILE).is_file()


def with_sidecar(change: Callable[[Scene, str], str]) -> Callable[[Scene], None]:
    def spoil(scene: Scene) -> None:
        first_run(scene)
        path = scene.out / "b.json"
        path.write_text(change(scene, path.read_text()))

    return spoil


def damaged_model(scene: Scene) -> None:
    first_run(scene)
    (path,) = (scene.out / "models").iterdir()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    scene.arguments = ["--overwrite"]


def given_model(data: bytes) -> Callable[[Scene], None]:
    def spoil(scene: Scene) -> None:
        path = scene.folder.parent / "m.safetensors"
        path.write_bytes(data)
        scene.arguments = ["--model", str(path)]

    return spoil


def stack_is_a_folder(scene: Scene) -> None:
    (scene.out / "b.tif" / "below").mkdir(parents=True)


def band_file_is_a_folder(scene: Scene) -> None:
    scene.arguments = ["--layout", "bands"]
    (scene.out / "b_nir.tif" / "below").mkdir(parents=True)


def held_by_another(scene: Scene) -> None:
    scene.out.mkdir()
    code = (
        "import sys, time; from pathlib import Path; from agalign.batch.output_folder import locked\n"
        "with locked(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    )
    other = subprocess.Popen([sys.executable, "-c", code, str(scene.out)], stdout=subprocess.PIPE, text=True)
    assert other.stdout is not None
    other.stdout.readline()

    def undo() -> None:
        other.kill()
        other.communicate()

    scene.undo = undo


def held_by_a_killed_one(scene: Scene) -> None:
    held_by_another(scene)
    scene.undo()
    scene.undo = lambda: None
    assert (scene.out / ".agalign.lock").is_file()


def vanishing(scene: Scene) -> None:
    scene.during = scene.file().unlink


def full_disk(scene: Scene) -> None:
    """A file system that holds a capture; without the right to mount one, files of at most 60 kB."""
    scene.out.mkdir()
    mounted = os.getuid() == 0 and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1600k", "tmpfs", str(scene.out)], capture_output=True
    ).returncode == 0  # fmt: skip
    if mounted:
        scene.undo = lambda: subprocess.run(["umount", "-l", str(scene.out)], check=True) and None
        return

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))

    scene.process = {"preexec_fn": limit}


def when_begun(act: Callable[["subprocess.Popen[str]", Scene], None], *arguments: str) -> Callable[[Scene], None]:
    """Something happens to a run of twelve captures once the first of them is done."""

    def spoil(scene: Scene) -> None:
        for place, name in enumerate("cdefghijkl"[: MANY - 2]):
            write_capture(scene.folder, name, place % 3)
        scene.arguments = list(arguments)

        def watch(process: "subprocess.Popen[str]") -> None:
            wait_until(lambda: any(scene.out.glob("?.json")))
            act(process, scene)

        scene.watch = watch

    return spoil


def a_worker(process: "subprocess.Popen[str]") -> psutil.Process:
    """A process that is doing a capture."""
    children = psutil.Process(process.pid).children(recursive=True)
    busy = {child: child.cpu_times() for child in children}
    return max(children, key=lambda child: (child.ppid() != process.pid, busy[child].user))


def kill_worker(process: "subprocess.Popen[str]", _scene: Scene) -> None:
    a_worker(process).kill()


def kill_capture(process: "subprocess.Popen[str]", scene: Scene) -> None:
    """Kill the only worker, and again when it tries the same capture once more, which it does last."""
    for finished in (1, MANY - 1):
        wait_until(lambda finished=finished: len(list(scene.out.glob("?.json"))) >= finished)
        (worker,) = workers(process)
        before_s = worker.cpu_times().user
        wait_until(lambda worker=worker, before_s=before_s: worker.cpu_times().user > before_s + 0.05)
        worker.kill()


def kill_workers_as_they_appear(process: "subprocess.Popen[str]", scene: Scene) -> None:
    wait_until(lambda: some_are_reported(scene))
    while process.poll() is None:
        kill_all_workers(process, scene)
        time.sleep(0.005)


def kill_all_workers(process: "subprocess.Popen[str]", _scene: Scene) -> None:
    for worker in workers(process):
        with contextlib.suppress(psutil.NoSuchProcess):
            worker.kill()


def kill_server(process: "subprocess.Popen[str]", _scene: Scene) -> None:
    """The process that starts the workers."""
    server = psutil.Process(workers(process)[0].ppid())
    assert server.pid != process.pid
    server.kill()


def workers(process: "subprocess.Popen[str]") -> list[psutil.Process]:
    try:
        return [c for c in psutil.Process(process.pid).children(recursive=True) if c.ppid() != process.pid]
    except psutil.NoSuchProcess:
        return []


def wait_until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not true():
        time.sleep(0.01)


def stop_worker(process: "subprocess.Popen[str]", _scene: Scene) -> None:
    a_worker(process).suspend()


def starve_workers(process: "subprocess.Popen[str]", scene: Scene) -> None:
    wait_until(lambda: some_are_reported(scene))
    for worker in workers(process):
        worker.rlimit(psutil.RLIMIT_AS, (1 << 20, 1 << 20))


def some_are_reported(scene: Scene) -> bool:
    """Of three captures of two workers: a worker begins its second one when its first one is reported."""
    return len(list(scene.out.glob("?.json"))) >= 3


def larger(scene: Scene) -> None:
    """Images that become larger and larger: a process must ask for more memory than it keeps from those before."""
    for path in scene.folder.iterdir():
        times = 2 + ALL.index(path.name[0]) // 3
        tifffile.imwrite(path, np.kron(tifffile.imread(path), np.ones((times, times), np.uint16)))


def signalled(number_: int) -> Callable[["subprocess.Popen[str]", Scene], None]:
    """Sent to all processes of the run, as a terminal does; none of them may be left."""

    def act(process: "subprocess.Popen[str]", scene: Scene) -> None:
        scene.children = psutil.Process(process.pid).children(recursive=True)
        os.killpg(process.pid, number_)

    return act


def interrupted_while_workers_start(scene: Scene) -> None:
    when_begun(signalled(signal.SIGINT), "-j", "2")(scene)
    act = signalled(signal.SIGINT)

    def watch(process: "subprocess.Popen[str]") -> None:
        wait_until(lambda: bool(psutil.Process(process.pid).children()))
        act(process, scene)

    scene.watch = watch


def terminated_while_files_are_read(scene: Scene) -> None:
    """SIGTERM to all processes while several of them read the tags of the files."""
    for number_ in range(1500):
        for band in ("green", "nir"):
            os.link(scene.file(f"a_{band}.tif"), scene.file(f"x{number_}_{band}.tif"))
    scene.arguments = ["-j", "2"]
    act = signalled(signal.SIGTERM)

    def watch(process: "subprocess.Popen[str]") -> None:
        wait_until(lambda: len(psutil.Process(process.pid).children()) > 1)
        time.sleep(0.3)
        act(process, scene)

    scene.watch = watch


def in_ascii(scene: Scene) -> None:
    scene.process = {"env": {**os.environ, "PYTHONIOENCODING": "ascii"}}


def in_c(scene: Scene) -> None:
    settings = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    scene.process = {"env": {**os.environ, **settings}}


def standard_output_full(scene: Scene) -> None:
    with Path("/dev/full").open("w") as full:
        scene.process = {"stdout": os.dup(full.fileno())}


def asking(*arguments: str) -> Callable[[Scene], None]:
    def spoil(scene: Scene) -> None:
        scene.arguments = list(arguments)

    return spoil


def lines(scene: Scene) -> None:
    for name in ("b_green.tif", "b_nir.tif"):
        tifffile.imwrite(scene.file(name), np.random.default_rng(0).integers(0, 60000, (1, 100000), np.uint16))


def sidecar_is_a_pipe(scene: Scene) -> None:
    scene.out.mkdir()
    os.mkfifo(scene.out / "b.json")


def model_is_a_pipe(scene: Scene) -> None:
    path = scene.folder.parent / "m.safetensors"
    os.mkfifo(path)
    scene.arguments = ["--model", str(path)]


def endless_number(scene: Scene) -> None:
    """In the sidecar of b, of which the report is to be made."""
    run_inside([str(scene.folder), "-o", str(scene.out), "-j", "1"], Scene(scene.folder, scene.out))
    path = scene.out / "b.json"
    path.write_text(re.sub(r'"seconds": [0-9.]+', '"seconds": 1e309', path.read_text()))
    scene.command = ["report", str(scene.out)]


def without_streams(*numbers: int) -> Callable[[Scene], None]:
    def spoil(scene: Scene) -> None:
        scene.process = {"preexec_fn": lambda: [os.close(n) for n in numbers] and None}

    return spoil


def unread_errors(scene: Scene) -> None:
    """As of `agalign ... 2>&1 | head -1`."""
    make_more = [chr(code) for code in range(ord("c"), ord("f"))]
    for number, name in enumerate(make_more, start=2):
        write_capture(scene.folder, name, number)
    read_end, write_end = os.pipe()
    os.close(read_end)
    scene.process = {"stderr": write_end}
    scene.undo = lambda: os.close(write_end)
    scene.watch = lambda _: None


def asking_too(*options: str) -> Callable[[Scene], None]:
    return lambda scene: scene.arguments.extend(options)


def long_temporary_folder(scene: Scene) -> None:
    folder = scene.folder.parent / ("t" * 150)
    folder.mkdir()
    scene.process = {"env": {**os.environ, "TMPDIR": str(folder)}}
    scene.arguments = ["-j", "2"]


def no_locks(scene: Scene) -> None:
    """As on NFS without its lock daemon."""

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    real, fcntl.flock = fcntl.flock, refuse

    def undo() -> None:
        fcntl.flock = real

    scene.undo = undo


def commanding(*command: str) -> Callable[[Scene], None]:
    def spoil(scene: Scene) -> None:
        scene.command = [part.format(folder=scene.folder, out=scene.out) for part in command]

    return spoil


def both(*spoils: Callable[[Scene], None]) -> Callable[[Scene], None]:
    def spoil(scene: Scene) -> None:
        for one in spoils:
            one(scene)

    return spoil


def long_model(scene: Scene) -> None:
    tagged(extratags=[(271, 2, 0, "Maker", True), (272, 2, 0, "M" * 300, True)])(scene)


def colliding(scene: Scene) -> None:
    """A multiband file whose capture would take a band's file of another."""
    scene.arguments = ["--layout", "both"]
    image = tifffile.imread(scene.file("a_nir.tif"))
    bands = np.stack([tifffile.imread(scene.file("a_green.tif")), image])
    tifffile.imwrite(scene.file("a_nir.tiff"), bands, photometric="minisblack", planarconfig="separate")


def fifo(scene: Scene) -> None:
    os.mkfifo(scene.folder / "c_nir.tif")


def counting_beyond(scene: Scene) -> None:
    path = scene.file()
    one, many = (struct.pack("<HHI", 273, 4, count) for count in (1, 1 << 30))
    path.write_bytes(path.read_bytes().replace(one, many, 1))


_SECOND = '"file": "b.tif",\n    "band_index": 2'
_NESTED = "<a>" * 1200 + "</a>" * 1200
_BOMB = (
    '<!DOCTYPE l [<!ENTITY a "aaaaaaaaaa">' + "".join(
        f'<!ENTITY {chr(98 + k)} "{("&" + chr(97 + k) + ";") * 10}">' for k in range(8)
    ) + ']>' + _PACKET.format("<Camera:BandName>&i;</Camera:BandName>")
)  # fmt: skip
_OUTSIDE = '<!DOCTYPE l [<!ENTITY a SYSTEM "file:///etc/passwd">]>' + _PACKET.format(
    "<Camera:BandName>&a;</Camera:BandName>"
)

FAULTS = (
    Fault("a TIFF cut short", edited(lambda data: data[: len(data) // 2]), 3, r"b_nir\.tif: .*copy it from the card"),
    Fault("half of a TIFF zeros", edited(lambda data: data[:2000] + bytes(len(data) - 2000)), 3, r"^b nir: "),
    Fault("wrong magic", edited(lambda data: b"XX" + data[2:]), 3, "b_nir.tif: is not a TIFF, JPEG or PNG"),
    Fault("no bytes at all", edited(lambda _: b""), 3, "b_nir.tif: is empty"),
    Fault("a text named .tif", extra("c_nir.tif", b"hello"), 3, "c_nir.tif: is not a TIFF", ("a", "b")),
    Fault("a folder named .tif", lambda s: (s.folder / "c_nir.tif").mkdir(), 0, "", ("a", "b")),
    Fault("a pipe named .tif", fifo, 3, "c_nir.tif: is not a regular file", ("a", "b")),
    Fault("symlinks that lead in a circle", loops, 3, "b_nir2.tif: cannot be read", ("a",)),
    Fault("a file without permission", forbidden(lambda s: s.file()), 3, r"b_nir.tif: cannot be read \(Permission"),
    Fault("a folder without permission", forbidden(lambda s: s.folder / "sub", "new"), 3,
          r"sub: cannot be looked into \(Permission denied\)", ("a", "b")),
    Fault("the system's folder on a card", forbidden(lambda s: s.folder / "lost+found", "new"), 0, "", ("a", "b")),
    Fault("an input that may only be read", read_only, 0, "", ("a", "b")),
    Fault("an output that may not be written", out_is_read_only, 1, "out: no permission to write there", ()),
    Fault("an output that is a file", lambda s: s.out.write_text("x") and None, 1, "out: is a file", ()),
    Fault("a file that vanishes during the run", vanishing, 3, r"b_nir\.tif: does not exist"),
    Fault("the disk full", full_disk, 3, "the disk is full|cannot be written", ("a",)),
    Fault("a worker killed by SIGKILL", when_begun(kill_worker, "-j", "2", "--timeout", "100"), 0, "", ALL),
    Fault("both workers killed by SIGKILL", when_begun(kill_all_workers, "-j", "2"), 0, "", ALL),
    Fault("a capture whose worker is killed twice",
          both(when_begun(kill_capture, "-j", "1", "--timeout", "100"), larger), 3,
          r"its worker process was killed \(signal 9; ", (), 1),
    Fault("each worker killed as it appears", when_begun(kill_workers_as_they_appear, "-j", "2"), 3,
          r"^3 worker processes one after another ended before they finished anything \(the last by signal 9", ()),
    Fault("the process that starts workers killed", when_begun(kill_server, "-j", "2"), 0, "", ALL),
    Fault("memory short in the workers", both(when_begun(starve_workers, "-j", "2", "--timeout", "100"), larger), 3,
          "out of memory|killed", ()),
    Fault("a capture that never ends", when_begun(stop_worker, "-j", "2", "--timeout", "4"), 3,
          "stopped after 4 s", (), 1),
    Fault("the interrupt key", when_begun(signalled(signal.SIGINT), "-j", "2"), 130, "interrupted; finished", ()),
    Fault("the interrupt key while workers start", interrupted_while_workers_start, 130, "interrupted; finished", ()),
    Fault("SIGTERM", when_begun(signalled(signal.SIGTERM), "-j", "2"), 143, "interrupted; finished", ()),
    Fault("SIGTERM while files are read", terminated_while_files_are_read, 143, "interrupted; finished", ()),
    Fault("XML entities that multiply", tagged(_BOMB), 0, "", ("a", "b")),
    Fault("an XML entity that names a file", tagged(_OUTSIDE), 0, "", ("a", "b")),
    Fault("XMP nested 1200 deep", tagged(_PACKET.format(_NESTED)), 0, "", ("a", "b")),
    Fault("XMP of five megabytes", xmp(f"<Camera:BandName>{'x' * 5_000_000}</Camera:BandName>"), 0, "", ("a", "b")),
    Fault("a thousand tags of one value of 2 MB", long_tags, 3, "b_nir.tif: .*declare 2000 MB"),
    Fault("a tag that counts beyond the file", counting_beyond, 3, "b_nir.tif: not a readable TIFF"),
    Fault("numbers in the tags that cannot be", both(
        xmp("<Camera:PerspectiveFocalLength>nan</Camera:PerspectiveFocalLength><Camera:PrincipalPoint>1e300,inf"
            "</Camera:PrincipalPoint><DLS:HorizontalIrradiance>-5</DLS:HorizontalIrradiance>"
            "<MicaSense:RadiometricCalibration>1e300,0,0</MicaSense:RadiometricCalibration>"),
        asking("--radiometry", "off")), 0, "", ("a", "b")),
    Fault("a sparse image of 100,000 x 100,000", enormous, 3, r"declares 100000 x 100000 pixels.*--max-pixels",
          ("a", "b")),
    Fault("an image of 65,535 bands", extra("c.tif", declared(64, 64, 65535)), 3, "c.tif: ", ("a", "b")),
    Fault("a band of another size", of_other_size, 0, "", ("a", "b")),
    Fault("images of one pixel", of_one_pixel, 3, "^b nir: "),
    Fault("a band that is all nodata", all_nodata, 3, "^b nir: "),
    Fault("names of every kind", strange_names, 0, "", ("a", "b", "-rf", "new\nline", "\x1b[31mred\a", "x" * 200)),
    Fault("a formula for a name", formulas, 0, "", ("a", "b")),
    Fault("a camera model of 300 characters", long_model, 0, "", ("a", "b")),
    Fault("an output inside the input", lambda s: setattr(s, "out", s.folder / "out"), 0, "", ("a", "b")),
    Fault("an earlier run inside the input, killed", killed_inside_the_input, 0, "", ("a", "b")),
    Fault("two captures that would write one file", colliding, 0, "", ("a", "b")),
    Fault("a TIFF that describes other files (VRT)", lambda s: s.file().write_text(vrt(s)) and None, 3,
          "b_nir.tif: is not a TIFF"),
    Fault("overviews that describe other files", overviews_elsewhere, 0, "", ("a", "b")),
    Fault("a sidecar that names files elsewhere",
          with_sidecar(lambda s, t: t.replace('"band_files": []', '"band_files": [{"file": "../a", "bytes": 1}]')),
          0, "", ("a", "b")),
    Fault("a sidecar nested 200,000 deep", with_sidecar(lambda *_: '{"schema": "agalign/1", "bands": ' + "[" * 200_000),
          0, "", ("a", "b")),
    Fault("a sidecar of width 0, for the report", both(
        with_sidecar(lambda _, t: re.sub(r'"width": \d+', '"width": 0', t)), commanding("report", "{out}")), 3,
        "b.json: reference.width"),
    Fault("a sidecar without permission, for the report", both(
        first_run, forbidden(lambda s: s.out / "b.json"), commanding("report", "{out}")), 3,
        r"b.json: cannot be read \(Permission"),
    Fault("a band index of 99 in a sidecar, for indices", both(
        with_sidecar(lambda _, t: t.replace(_SECOND, _SECOND.replace("2", "99"))),
        commanding("ndvi", "{out}", "--index", "gndvi")), 3, "b.tif: has no band 99", ("a", "b")),
    Fault("a model of an earlier run, damaged", damaged_model, 0, "", ("a", "b")),
    Fault("a malformed model file", given_model(b"\x40" + bytes(7) + b"{" + b"[" * 63), 1,
          "m.safetensors: cannot be read", ()),
    Fault("a folder where a stack belongs", stack_is_a_folder, 3, "b.tif: cannot be written"),
    Fault("a folder where a band's file belongs", band_file_is_a_folder, 3, "b_nir.tif: cannot be written"),
    Fault("another run in the same output", held_by_another, 1, r"out: another run writes there \(process \d+ on ", ()),
    Fault("the lock of a killed run", held_by_a_killed_one, 0, "", ("a", "b")),
    Fault("a terminal of ASCII", both(strange_names, in_ascii), 0, "", ("a", "b")),
    Fault("a system without letters beyond ASCII", both(strange_names, in_c), 3,
          "the system encoding cannot represent its name", ("a", "b")),
    Fault("standard output full", standard_output_full, 1, "standard output|output: No space left", ("a", "b")),
    Fault("a random seed beyond 64 bits", asking("--rng-seed", "9" * 30), 2, "--rng-seed: give", ()),
    Fault("a torch device without data", asking("--device", "meta"), 2, "device 'meta' cannot be used", ()),
    Fault("images of a line of 100,000 pixels", lines, 3, "^b nir: "),
    Fault("a pipe where a sidecar belongs", sidecar_is_a_pipe, 0, "", ("a", "b")),
    Fault("a pipe for a model", model_is_a_pipe, 1, r"m\.safetensors: .*not a regular file", ()),
    Fault("an infinite number in a sidecar, for the report", endless_number, 3, r"b\.json: .*finite", ("a",)),
    Fault("an infinite number in an earlier sidecar", both(
        endless_number, commanding("{folder}", "-o", "{out}", "-j", "1")), 0, "", ("a", "b")),
    Fault("standard output closed", without_streams(1), 0, "", ("a", "b")),
    Fault("all standard streams closed", without_streams(0, 1, 2), 0, "", ("a", "b")),
    Fault("standard error that is not read", unread_errors, 0, "", tuple("abcde")),
    Fault("JSON lines that are not read", both(unread_errors, asking_too("--log-json")), 0, "", tuple("abcde")),
    Fault("a temporary folder with a name of 150 letters", long_temporary_folder, 0, "", ("a", "b")),
    Fault("a file system without locks", no_locks, 0, "", ("a", "b")),
    Fault("an empty name for the folder", commanding("", "-o", "{out}"), 2, "the name of the folder is empty", ()),
    Fault("a focal length of 1e308 mm in the tags", xmp(
        "<Camera:PerspectiveFocalLength>1e308</Camera:PerspectiveFocalLength>"
        "<Camera:PerspectiveFocalLengthUnits>mm</Camera:PerspectiveFocalLengthUnits>"), 0, "", ("a", "b")),
    Fault("one of GDAL's virtual paths", commanding("/vsizip/flight.zip", "-o", "{out}"), 1, "virtual paths", ()),
)  # fmt: skip


def main() -> None:
    """The table of docs/reliability.md: the faults after which a run ends with another exit code than 0."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
    from common import Section

    document = Path(sys.argv[2]) if sys.argv[1:2] == ["--markdown"] else None
    rows = [("fault", "exit code", "first message")]
    failed = []
    for fault in FAULTS:
        with tempfile.TemporaryDirectory() as folder:
            seen = run_fault(fault, Path(folder))
            row = (fault.name, str(seen.code), told(seen, Path(folder)))
        if seen.code:
            rows.append(row)
        wrong = what_is_wrong(fault, seen)
        failed += [f"{fault.name}: {wrong}"] if wrong else []
        print(f"{seen.seconds:5.1f} s  {' | '.join(row)}  {wrong}", flush=True)
    section = Section("faults", document)
    section.table(rows)
    if failed:
        raise SystemExit("\n".join(failed))


def told(seen: Seen, folder: Path) -> str:
    """The first complaint, without this machine's paths."""
    first = next(iter(seen.complaints), "")
    first = re.sub(rf"{re.escape(str(folder))}/(?:flight/|out/)?", "", first)
    return re.sub(r"process \d+ on [^)]+", "process … on …", first)[:160]


def what_is_wrong(fault: Fault, seen: Seen) -> str:
    """Nothing where a fault came to what it must come to."""
    wrong = []
    if seen.code != fault.code:
        wrong.append(f"exit code {seen.code}, not {fault.code}")
    if "Traceback" in seen.output or "please report" in seen.output:
        wrong.append(f"a traceback: {seen.output[-1500:]}")
    if "\x1b[31mred" in seen.output or "\a" in seen.output:
        wrong.append("an escape sequence reached the terminal")
    if fault.says and not any(re.search(fault.says, line) for line in seen.complaints):
        wrong.append(f"complaints {seen.complaints}")
    if not fault.says and seen.complaints:
        wrong.append(f"complaints {seen.complaints}")
    # What was stopped may have been written before.
    if fault.all_but is not None and len(seen.finished) < MANY - fault.all_but:
        wrong.append(f"{len(seen.finished)} captures finished")
    if "left behind" in seen.output:
        wrong.append("processes are left")
    if missing := set(fault.finished) - set(seen.finished):
        wrong.append(f"not finished: {sorted(missing)}")
    return "; ".join(wrong)


if __name__ == "__main__":
    main()
