"""Faults of cards, disks, machines and files, and the results that the program must have.

Each fault is done to a small flight of two good captures, `a` and `b`, and the program is run on it. `python -m
tests.reliability.faults` prints the result of each fault, and with `--markdown docs/reliability.md` updates the table
of that page. test_faults.py compares the result of each fault with the expected one.
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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import psutil
import tifffile

from agalign.cli import align_run as cli_run
from agalign.errors import SidecarError
from agalign.products.sidecar.file import find_sidecars, read_sidecar
from agalign.values.files import RUN_FILE

from ..conftest import textured_pair
from ..program import agalign_here

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "reliability.md"
SHIFT = np.array([[1, 0, 6.0], [0, 1, -4.0], [0, 0, 1]])
SIZE_PX = 320, 240
ALL = "abcdefghijkl"
"""Captures of a run that something happens to."""
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
    during: Callable[[], None] = lambda: None
    """Done when the captures are found."""
    watch: Callable[["subprocess.Popen[str]"], None] | None = None
    """Done while the program runs, in a process of its own."""
    process: dict[str, Any] = field(default_factory=dict)
    """How that process is started, where it must have one."""
    options: tuple[str, ...] = ()
    """Options that save time in what the fault does not concern."""
    undo: Callable[[], None] = lambda: None
    children: list[psutil.Process] = field(default_factory=list)
    """Processes that must not outlive the program."""

    def file(self, name: str = "b_nir.tif") -> Path:
        return self.folder / name

    def run_of(self, out: Path) -> list[str]:
        """Arguments of a usual run into this folder."""
        return [str(self.folder), "-o", str(out), "-j", "1", *self.options]


Inject = Callable[[Scene], object]
"""Does a fault to a flight or to a run."""


@dataclass(frozen=True)
class Ends:
    """How a run must end."""

    code: int
    says: str = ""
    """A pattern of one of the complaints; nothing is to be complained of where it is empty."""
    finished: Sequence[str] = "a"
    """Captures that must be aligned all the same."""
    all_but: int | None = None
    """This many of the twelve captures of a longer run are lost, whichever."""


@dataclass(frozen=True)
class Fault:
    """Something that is wrong."""

    name: str
    inject: Inject
    ends: Ends

    @property
    def is_in_full_run(self) -> bool:
        return self.inject in _IN_FULL_RUN


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


def run_fault(fault: Fault, folder: Path, model: Path | None = None) -> Seen:
    """Make a flight, do the fault to it, run the program; `model` is that of a flight without faults."""
    scene = Scene(folder / "flight", folder / "out")
    if model is not None:
        scene.options = ("--relief", "never", "--model", str(model))
    make_flight(scene.folder)
    fault.inject(scene)
    command = scene.command or scene.run_of(scene.out)
    began = time.monotonic()
    try:
        run = run_outside if scene.watch or scene.process else run_inside
        code, output = run([*command, *scene.arguments], scene)
        whole = aligned(scene.out)
    finally:
        scene.undo()
    complaints = [line.removeprefix("agalign: ") for line in output.splitlines() if line.startswith("agalign: ")]
    return Seen(code, complaints, whole, output, time.monotonic() - began)


def make_model(folder: Path) -> None:
    """Learn the model of a flight without faults."""
    make_flight(folder / "flight")
    done = agalign_here(folder / "flight", "-o", folder / "out", "-j", "1", "--relief", "never")
    assert done.returncode == 0, done.stderr


def aligned(out: Path) -> list[str]:
    """Captures with all bands aligned."""
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
        scene.during()
        return flight

    with mock.patch.object(cli_run, "find_captures", result):
        done = agalign_here(*arguments)
    return done.returncode, done.stderr


def run_outside(arguments: list[str], scene: Scene) -> tuple[int, str]:
    """In a process of its own: (exit code, standard error)."""
    given = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    given |= scene.process
    with subprocess.Popen([sys.executable, "-m", "agalign", *arguments], **given) as process:
        if scene.watch is not None:
            scene.watch(process)
        _, errors = process.communicate()
    psutil.wait_procs(scene.children)
    return process.returncode, errors or ""


# ---- what is done to files


def edited(change: Callable[[bytes], bytes]) -> Inject:
    def inject(scene: Scene) -> None:
        path = scene.file()
        path.write_bytes(change(path.read_bytes()))

    return inject


def extra(name: str, data: bytes) -> Inject:
    return lambda scene: (scene.folder / name).write_bytes(data)


def tagged(packet: str | None = None, *tags: tuple[int, int, int, str, bool]) -> Inject:
    """Both files of b with an XMP packet and other tags."""

    def inject(scene: Scene) -> None:
        data = (packet or "").encode()
        extratags = [(XMP, 1, len(data), data, True), *tags] if data else tags
        for path in (scene.file("b_green.tif"), scene.file()):
            tifffile.imwrite(path, tifffile.imread(path), extratags=extratags)

    return inject


def xmp(values: str) -> Inject:
    return tagged(_PACKET.format(values))


def directory_of(entries: list[tuple[int, int, int, bytes]], more: bytes = b"") -> bytes:
    """A little-endian TIFF of (tag, type, count, value or place), and what follows."""
    body = b"".join(struct.pack("<HHI", *head) + value.ljust(4, b"\0") for *head, value in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + struct.pack("<I", 0) + more


def number(value: int) -> bytes:
    return struct.pack("<I", value)


def image_of(width: int, height: int, bands: int = 1) -> list[tuple[int, int, int, bytes]]:
    """The tags of an image that has no pixels."""
    sizes = {256: width, 257: height, 273: 8, 278: height, 279: 1}
    kinds = {258: 8, 259: 1, 262: 1, 277: bands, 284: 2 if bands > 1 else 1}
    longs, shorts = ([(tag, type_, 1, number(v)) for tag, v in of.items()] for of, type_ in ((sizes, 4), (kinds, 3)))
    return sorted(longs + shorts)


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
    """A VRT that would read another file or contact a server."""
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


def loops(scene: Scene) -> None:
    (scene.folder / "loop").symlink_to(scene.folder)
    (scene.folder / "b_nir2.tif").symlink_to(scene.folder / "b_nir2.tif")


def without_permission(scene: Scene, target: Path, mode: int) -> None:
    """Root passes over permissions by two capabilities, which the program is started without."""

    def drop_capabilities() -> None:
        libc = ctypes.CDLL(None)
        for capability in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
            libc.prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP

    target.chmod(mode)
    scene.process = {"preexec_fn": drop_capabilities}
    scene.undo = lambda: target.chmod(0o755)


def forbidden(path: Callable[[Scene], Path], name: str = "", mode: int = 0) -> Inject:
    """A file or folder that whoever runs the program may not read."""

    def inject(scene: Scene) -> None:
        if name:
            path(scene).mkdir()
        without_permission(scene, path(scene), mode)

    return inject


def read_only(scene: Scene) -> None:
    for path in scene.folder.iterdir():
        path.chmod(0o444)
    without_permission(scene, scene.folder, 0o555)


# ---- what is done to runs


def first_run(scene: Scene, out: Path | None = None) -> None:
    code, output = run_inside(scene.run_of(out or scene.out), scene)
    assert code == 0, output


def killed_inside_the_input(scene: Scene) -> None:
    """An earlier run wrote below its input, and was killed before its report."""
    earlier = scene.folder / "earlier"
    first_run(scene, earlier)
    for name in ("summary.csv", "index.html"):
        (earlier / name).unlink()
    assert (earlier / RUN_FILE).is_file()


def with_sidecar(change: Callable[[Scene, str], str]) -> Inject:
    def inject(scene: Scene) -> None:
        first_run(scene)
        path = scene.out / "b.json"
        path.write_text(change(scene, path.read_text()))

    return inject


def learning(scene: Scene) -> None:
    """The run learns its own model, although one that fits is there."""
    scene.options = ()


def damaged_model(scene: Scene) -> None:
    learning(scene)
    first_run(scene)
    (path,) = (scene.out / "models").iterdir()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    scene.arguments = ["--overwrite"]


def given_model(make: Callable[[Path], object]) -> Inject:
    def inject(scene: Scene) -> None:
        path = scene.folder.parent / "m.safetensors"
        make(path)
        scene.arguments = ["--model", str(path)]

    return inject


def output_is_a_folder(name: str) -> Inject:
    return lambda scene: (scene.out / name / "below").mkdir(parents=True)


def held_by_another(scene: Scene) -> None:
    scene.out.mkdir()
    code = (
        "import sys, time; from pathlib import Path; from agalign.values.output_folder import locked\n"
        "with locked(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    )
    other = subprocess.Popen([sys.executable, "-c", code, str(scene.out)], stdout=subprocess.PIPE, text=True)
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


def full_disk(scene: Scene) -> None:
    """A file system that holds a capture; without the right to mount one, files of at most 60 kB."""
    scene.out.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1600k", "tmpfs", str(scene.out)]
    if os.getuid() == 0 and subprocess.run(mount, capture_output=True).returncode == 0:
        scene.undo = lambda: subprocess.run(["umount", "-l", str(scene.out)], check=True) and None
        return

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))

    scene.process = {"preexec_fn": limit}


Act = Callable[["subprocess.Popen[str]", Scene], object]
"""Is done to a run."""


def when(ready: Act, act: Act, *arguments: str) -> Inject:
    """Something happens to a run once `ready` returns something true."""

    def inject(scene: Scene) -> None:
        scene.arguments = list(arguments)

        def watch(process: "subprocess.Popen[str]") -> None:
            wait_until(process, lambda: bool(ready(process, scene)))
            act(process, scene)

        scene.watch = watch

    return inject


def with_captures(names: str) -> Inject:
    """More captures."""
    return lambda scene: [write_capture(scene.folder, name, place % 3) for place, name in enumerate(names)]


def when_begun(act: Act, *arguments: str) -> Inject:
    """Something happens to a run of twelve captures once the first of them is done."""
    return both(with_captures(ALL[2:]), when(lambda _, scene: any(scene.out.glob("?.json")), act, *arguments))


def has_children(count: int) -> Act:
    return lambda process, _: len(psutil.Process(process.pid).children()) >= count


def a_worker(process: "subprocess.Popen[str]") -> psutil.Process:
    """A process that is doing a capture."""
    children = psutil.Process(process.pid).children(recursive=True)
    busy = {child: child.cpu_times() for child in children}
    return max(children, key=lambda child: (child.ppid() != process.pid, busy[child].user))


def kill_worker(process: "subprocess.Popen[str]", _scene: Scene) -> None:
    a_worker(process).kill()


def kill_capture(process: "subprocess.Popen[str]", scene: Scene) -> None:
    """Kill the only worker, and again when it tries the same capture once more, which it does last."""
    for finished in (1, len(ALL) - 1):
        wait_for_reports(process, scene, finished)
        (worker,) = workers(process)
        before_s = worker.cpu_times().user
        wait_until(process, lambda worker=worker, before_s=before_s: worker.cpu_times().user > before_s + 0.05)
        worker.kill()


def workers(process: "subprocess.Popen[str]") -> list[psutil.Process]:
    try:
        return [c for c in psutil.Process(process.pid).children(recursive=True) if c.ppid() != process.pid]
    except psutil.NoSuchProcess:
        return []


def wait_until(process: "subprocess.Popen[str]", true: Callable[[], bool]) -> None:
    while not true():
        assert process.poll() is None or true(), "the run ended before the fault"
        time.sleep(0.01)


def stop_worker(process: "subprocess.Popen[str]", _scene: Scene) -> None:
    a_worker(process).suspend()


def starve_workers(process: "subprocess.Popen[str]", scene: Scene) -> None:
    wait_for_reports(process, scene)
    for worker in workers(process):
        worker.rlimit(psutil.RLIMIT_AS, (1 << 20, 1 << 20))


def wait_for_reports(process: "subprocess.Popen[str]", scene: Scene, captures: int = 3) -> None:
    """Wait until captures are reported: of three by two workers, one has begun its second."""
    wait_until(process, lambda: len(list(scene.out.glob("?.json"))) >= captures)


def larger(scene: Scene) -> None:
    """Images that become larger and larger: a process must ask for more memory than it keeps from those before.

    No model fits them.
    """
    learning(scene)
    for path in scene.folder.iterdir():
        times = 2 + ALL.index(path.name[0]) // 3
        tifffile.imwrite(path, np.kron(tifffile.imread(path), np.ones((times, times), np.uint16)))


def signalled(number_: int, after_s: float = 0.0) -> Act:
    """Sent to all processes of the run, as a terminal does; none of them may be left."""

    def act(process: "subprocess.Popen[str]", scene: Scene) -> None:
        time.sleep(after_s)
        scene.children = psutil.Process(process.pid).children(recursive=True)
        os.killpg(process.pid, number_)

    return act


def many_files(scene: Scene) -> None:
    """So many that several processes read their tags."""
    for number_ in range(1500):
        for band in ("green", "nir"):
            os.link(scene.file(f"a_{band}.tif"), scene.file(f"x{number_}_{band}.tif"))


def with_environment(**variables: str) -> Inject:
    return lambda scene: scene.process.update(env={**os.environ, **variables})


def standard_output_full(scene: Scene) -> None:
    with Path("/dev/full").open("w") as full:
        scene.process = {"stdout": os.dup(full.fileno())}


def asking(*options: str) -> Inject:
    return lambda scene: scene.arguments.extend(options)


def lines(scene: Scene) -> None:
    for name in ("b_green.tif", "b_nir.tif"):
        tifffile.imwrite(scene.file(name), np.random.default_rng(0).integers(0, 60000, (1, 100000), np.uint16))


def sidecar_is_a_pipe(scene: Scene) -> None:
    scene.out.mkdir()
    os.mkfifo(scene.out / "b.json")


def endless_number(scene: Scene) -> None:
    with_sidecar(lambda _, text: re.sub(r'"seconds": [0-9.]+', '"seconds": 1e309', text))(scene)
    commanding("report {out}")(scene)


def without_streams(*numbers: int) -> Inject:
    def inject(scene: Scene) -> None:
        scene.process = {"preexec_fn": lambda: [os.close(n) for n in numbers] and None}

    return inject


def unread_errors(scene: Scene) -> None:
    """As of `agalign ... 2>&1 | head -1`."""
    with_captures("cde")(scene)
    read_end, write_end = os.pipe()
    os.close(read_end)
    scene.process = {"stderr": write_end}
    scene.undo = lambda: os.close(write_end)
    scene.watch = lambda _: None


def long_temporary_folder(scene: Scene) -> None:
    folder = scene.folder.parent / ("t" * 150)
    folder.mkdir()
    with_environment(TMPDIR=str(folder))(scene)
    scene.arguments = ["-j", "2"]


def no_locks(scene: Scene) -> None:
    """As on NFS without its lock daemon."""
    patch = mock.patch.object(fcntl, "flock", side_effect=OSError(errno.ENOLCK, "No locks available"))
    patch.start()
    scene.undo = patch.stop


def commanding(command: str) -> Inject:
    return lambda scene: setattr(scene, "command", command.format(folder=scene.folder, out=scene.out).split(" "))


def both(*injections: Inject) -> Inject:
    return lambda scene: [inject(scene) for inject in injections]


def colliding(scene: Scene) -> None:
    """A multiband file with the output name of another capture's band."""
    scene.arguments = ["--layout", "both"]
    image = tifffile.imread(scene.file("a_nir.tif"))
    bands = np.stack([tifffile.imread(scene.file("a_green.tif")), image])
    tifffile.imwrite(scene.file("a_nir.tiff"), bands, photometric="minisblack", planarconfig="separate")


def counting_beyond(scene: Scene) -> None:
    path = scene.file()
    one, many = (struct.pack("<HHI", 273, 4, count) for count in (1, 1 << 30))
    path.write_bytes(path.read_bytes().replace(one, many, 1))


_IN_FULL_RUN: list[Inject] = []


def in_full_run(inject: Inject) -> Inject:
    """A fault of the full tests alone, because it takes long and others are like it."""
    _IN_FULL_RUN.append(inject)
    return inject


_SECOND = '"file": "b.tif",\n    "band_index": 2'
_NESTED = "<a>" * 1200 + "</a>" * 1200
_BOMB = (
    '<!DOCTYPE l [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY {chr(98 + k)} "{("&" + chr(97 + k) + ";") * 10}">' for k in range(8))
    + "]>"
    + _PACKET.format("<Camera:BandName>&i;</Camera:BandName>")
)
_OUTSIDE = '<!DOCTYPE l [<!ENTITY a SYSTEM "file:///etc/passwd">]>' + _PACKET.format(
    "<Camera:BandName>&a;</Camera:BandName>"
)

ALL_FINISHED: dict[str, Inject] = {
    "a folder named .tif": lambda s: (s.folder / "c_nir.tif").mkdir(),
    "the system's folder on a card": in_full_run(forbidden(lambda s: s.folder / "lost+found", "new")),
    "an input that may only be read": in_full_run(read_only),
    "XMP nested 1200 deep": in_full_run(tagged(_PACKET.format(_NESTED))),
    "numbers in the tags that cannot be": both(
        xmp(
            "<Camera:PerspectiveFocalLength>nan</Camera:PerspectiveFocalLength><Camera:PrincipalPoint>1e300,inf"
            "</Camera:PrincipalPoint><DLS:HorizontalIrradiance>-5</DLS:HorizontalIrradiance>"
            "<MicaSense:RadiometricCalibration>1e300,0,0</MicaSense:RadiometricCalibration>"
        ),
        asking("--radiometry", "off"),
    ),
    "a band of another size": of_other_size,
    "a formula for a name": in_full_run(lambda s: write_capture(s.folder, '=HYPERLINK("a")', 3)),
    "a camera model of 300 characters": both(
        learning, tagged(None, (271, 2, 0, "Maker", True), (272, 2, 0, "M" * 300, True))
    ),
    "an output inside the input": lambda s: setattr(s, "out", s.folder / "out"),
    "an earlier run inside the input, killed": in_full_run(killed_inside_the_input),
    "two captures that would write one file": in_full_run(colliding),
    "overviews that describe other files": overviews_elsewhere,
    "a sidecar that names files elsewhere": with_sidecar(
        lambda s, t: t.replace('"band_files": []', '"band_files": [{"file": "../a", "bytes": 1}]')
    ),
    "a sidecar nested 200,000 deep": in_full_run(
        with_sidecar(lambda *_: '{"schema": "agalign/1", "bands": ' + "[" * 200_000)
    ),
    "a model of an earlier run, damaged": damaged_model,
    "the lock of a killed run": held_by_a_killed_one,
    "a terminal of ASCII": in_full_run(both(strange_names, with_environment(PYTHONIOENCODING="ascii"))),
    "a pipe where a sidecar belongs": sidecar_is_a_pipe,
    "an infinite number in an earlier sidecar": in_full_run(both(endless_number, commanding("{folder} -o {out} -j 1"))),
    "standard output closed": in_full_run(without_streams(1)),
    "all standard streams closed": in_full_run(without_streams(0, 1, 2)),
    "a temporary folder with a name of 150 letters": in_full_run(long_temporary_folder),
    "a file system without locks": no_locks,
    "a focal length of 1e308 mm in the tags": in_full_run(
        xmp(
            "<Camera:PerspectiveFocalLength>1e308</Camera:PerspectiveFocalLength>"
            "<Camera:PerspectiveFocalLengthUnits>mm</Camera:PerspectiveFocalLengthUnits>"
        )
    ),
}
"""After these, both captures are aligned, without a complaint."""
B_IS_LOST: dict[str, tuple[Inject, str]] = {
    "a TIFF cut short": (edited(lambda data: data[: len(data) // 2]), r"b_nir\.tif: .*copy it from the card"),
    "half of a TIFF zeros": (edited(lambda data: data[:2000] + bytes(len(data) - 2000)), r"^b nir: "),
    "wrong magic": (edited(lambda data: b"XX" + data[2:]), "b_nir.tif: is not a TIFF, JPEG or PNG"),
    "no bytes at all": (edited(lambda _: b""), "b_nir.tif: is empty"),
    "a file without permission": (forbidden(lambda s: s.file()), r"b_nir.tif: cannot be read \(Permission"),
    "a file that vanishes during the run": (
        lambda s: setattr(s, "during", s.file().unlink),
        r"b_nir\.tif: does not exist",
    ),
    "a thousand tags of one value of 2 MB": (in_full_run(long_tags), "b_nir.tif: .*declare more than 32 MB"),
    "a tag that counts beyond the file": (counting_beyond, "b_nir.tif: not a readable TIFF"),
    "images of one pixel": (of_one_pixel, "^b nir: "),
    "a band that is all nodata": (all_nodata, "^b nir: "),
    "a TIFF that describes other files (VRT)": (lambda s: s.file().write_text(vrt(s)), "b_nir.tif: is not a TIFF"),
    "a sidecar of width 0, for the report": (
        both(with_sidecar(lambda _, t: re.sub(r'"width": \d+', '"width": 0', t)), commanding("report {out}")),
        "b.json: reference.width",
    ),
    "a sidecar without permission, for the report": (
        in_full_run(both(first_run, forbidden(lambda s: s.out / "b.json"), commanding("report {out}"))),
        r"b.json: cannot be read \(Permission",
    ),
    "a folder where a stack belongs": (output_is_a_folder("b.tif"), "b.tif: cannot be written"),
    "a folder where a band's file belongs": (
        both(output_is_a_folder("b_nir.tif"), asking("--layout", "bands")),
        "b_nir.tif: cannot be written",
    ),
    "images of a line of 100,000 pixels": (lines, "^b nir: "),
}
"""After these, the other capture is aligned; with a pattern of the complaint."""
FILE_IS_NAMED: dict[str, tuple[Inject, str]] = {
    "a text named .tif": (extra("c_nir.tif", b"hello"), "c_nir.tif: is not a TIFF"),
    "a pipe named .tif": (lambda s: os.mkfifo(s.folder / "c_nir.tif"), "c_nir.tif: is not a regular file"),
    "a folder without permission": (
        in_full_run(forbidden(lambda s: s.folder / "sub", "new")),
        r"sub: cannot be looked into \(Permission denied\)",
    ),
    "a sparse image of 100,000 x 100,000": (enormous, r"declares 100000 x 100000 pixels.*--max-pixels"),
    "an image of 65,535 bands": (extra("c.tif", declared(64, 64, 65535)), "c.tif: "),
    "a band index of 99 in a sidecar, for indices": (
        both(
            with_sidecar(lambda _, t: t.replace(_SECOND, _SECOND.replace("2", "99"))),
            commanding("ndvi {out} --index gndvi"),
        ),
        "b.tif: has no band 99",
    ),
    "a system without letters beyond ASCII": (
        in_full_run(both(strange_names, with_environment(LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0"))),
        "its name is not valid ASCII; rename it, or set LC_ALL=C.UTF-8",
    ),
}
"""After these, both captures are aligned, and another file is complained of."""
REFUSED: dict[str, tuple[Inject, int, str]] = {
    "an output that may not be written": (
        in_full_run(forbidden(lambda s: s.out, "new", 0o555)),
        1,
        "out: no permission to write there",
    ),
    "an output that is a file": (lambda s: s.out.write_text("x"), 1, "out: is a file"),
    "a malformed model file": (
        given_model(lambda path: path.write_bytes(b"\x40" + bytes(7) + b"{" + b"[" * 63)),
        1,
        "m.safetensors: cannot be read",
    ),
    "another run in the same output": (held_by_another, 1, r"out: another run writes there \(process \d+ on "),
    "a random seed beyond 64 bits": (asking("--rng-seed", "9" * 30), 2, "--rng-seed: give"),
    "a torch device without data": (asking("--device", "meta"), 2, "device 'meta' cannot be used"),
    "a pipe for a model": (given_model(os.mkfifo), 1, r"m\.safetensors: .*not a regular file"),
    "an empty name for the folder": (commanding(" -o {out}"), 2, "the name of the folder is empty"),
    "one of GDAL's virtual paths": (commanding("/vsizip/flight.zip -o {out}"), 1, "virtual paths"),
}
"""These end the run: with the exit code and a pattern of the complaint."""
OTHERS = {
    "XML entities that multiply": (
        in_full_run(tagged(_BOMB)),
        Ends(0, "b_nir.tif: its XMP packet .* lacks BandName", "ab"),
    ),
    "an XML entity that names a file": (
        in_full_run(tagged(_OUTSIDE)),
        Ends(0, "b_nir.tif: its XMP packet .* lacks BandName", "ab"),
    ),
    "XMP of five megabytes": (
        in_full_run(xmp(f"<Camera:BandName>{'x' * 5_000_000}</Camera:BandName>")),
        Ends(0, "b_nir.tif: its XMP packet is damaged and lacks its end, BandName", "ab"),
    ),
    "symlinks that lead in a circle": (loops, Ends(3, "b_nir2.tif: cannot be read", "a")),
    "the disk full": (full_disk, Ends(3, "the disk is full|cannot be written", "a")),
    "a worker killed by SIGKILL": (when_begun(kill_worker, "-j", "2", "--timeout", "100"), Ends(0, "", ALL)),
    "a worker killed twice at one capture": (
        in_full_run(both(when_begun(kill_capture, "-j", "1", "--timeout", "100"), larger)),
        Ends(3, r"its worker process was killed \(signal 9; ", "", 1),
    ),
    "memory short in the workers": (
        in_full_run(both(when_begun(starve_workers, "-j", "2", "--timeout", "100"), larger)),
        Ends(3, "out of memory|killed", ""),
    ),
    "a capture that never ends": (
        in_full_run(when_begun(stop_worker, "-j", "2", "--timeout", "4")),
        Ends(3, "stopped after 4 s", "", 1),
    ),
    "the interrupt key": (when_begun(signalled(signal.SIGINT), "-j", "2"), Ends(130, "interrupted; finished", "")),
    "the interrupt key, workers of Dask": (
        in_full_run(when_begun(signalled(signal.SIGINT), "--dask", "local")),
        Ends(130, "interrupted; finished", ""),
    ),
    "the interrupt key while workers start": (
        in_full_run(both(with_captures(ALL[2:]), when(has_children(1), signalled(signal.SIGINT), "-j", "2"))),
        Ends(130, "interrupted; finished", ""),
    ),
    "SIGTERM": (in_full_run(when_begun(signalled(signal.SIGTERM), "-j", "2")), Ends(143, "interrupted; finished", "")),
    "SIGTERM while files are read": (
        in_full_run(both(many_files, when(has_children(2), signalled(signal.SIGTERM, 0.3), "-j", "2"))),
        Ends(143, "interrupted; finished", ""),
    ),
    "names of every kind": (
        in_full_run(strange_names),
        Ends(0, "", ("a", "b", "-rf", "new\nline", "\x1b[31mred\a", "x" * 200)),
    ),
    "standard output full": (standard_output_full, Ends(1, "standard output|output: No space left", "ab")),
    "an infinite number in a sidecar, for the report": (endless_number, Ends(3, r"b\.json: .*finite", "a")),
    "standard error that is not read": (in_full_run(unread_errors), Ends(0, "", "abcde")),
    "JSON lines that are not read": (in_full_run(both(unread_errors, asking("--log-json"))), Ends(0, "", "abcde")),
}
FAULTS = (
    *(Fault(name, inject, Ends(0, "", "ab")) for name, inject in ALL_FINISHED.items()),
    *(Fault(name, inject, Ends(3, says)) for name, (inject, says) in B_IS_LOST.items()),
    *(Fault(name, inject, Ends(3, says, "ab")) for name, (inject, says) in FILE_IS_NAMED.items()),
    *(Fault(name, inject, Ends(code, says, "")) for name, (inject, code, says) in REFUSED.items()),
    *(Fault(name, inject, ends) for name, (inject, ends) in OTHERS.items()),
)


def documented() -> dict[str, str]:
    """{fault: exit code} in the table of the most common faults."""
    section = (
        DOCUMENT.read_text(encoding="utf-8").partition("<!-- faults -->")[2].partition("<!-- end of faults -->")[0]
    )
    rows = [line.removeprefix("| ").split(" | ") for line in section.splitlines() if line.startswith("| ")][2:]
    return {name: code for name, code, *_ in rows}


def main() -> None:
    """Print the result of each fault, and write the table of docs/reliability.md."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
    from common import report

    document = Path(sys.argv[2]) if sys.argv[1:2] == ["--markdown"] else None
    rows, reported = [("fault", "exit code", "first message, without the remedy")], documented()
    failed = []
    for fault in FAULTS:
        with tempfile.TemporaryDirectory() as folder:
            seen = run_fault(fault, Path(folder))
            row = (fault.name, str(seen.code), first_complaint(seen, Path(folder)))
        if fault.name in reported:
            rows.append(row)
        wrong = what_is_wrong(fault, seen)
        failed += [f"{fault.name}: {wrong}"] if wrong else []
        print(f"{seen.seconds:5.1f} s  {' | '.join(row)}  {wrong}", flush=True)
    report("faults", document, rows)
    if failed:
        raise SystemExit("\n".join(failed))


def first_complaint(seen: Seen, folder: Path) -> str:
    """The first complaint, without its remedy and without this machine's paths."""
    first = re.split("; (?!agalign needs|out of memory)", next(iter(seen.complaints), ""))[0]
    first = re.sub(rf"{re.escape(str(folder))}/(?:flight/|out/)?", "", first)
    return re.sub(r"process \d+ on [^)]+", "process … on …", first)[:160]


def what_is_wrong(fault: Fault, seen: Seen) -> str:
    """Nothing where a fault came to what it must come to."""
    wrong = []
    if seen.code != fault.ends.code:
        wrong.append(f"exit code {seen.code}, not {fault.ends.code}")
    if "Traceback" in seen.output or "please report" in seen.output:
        wrong.append(f"a traceback: {seen.output[-1500:]}")
    if "\x1b[31mred" in seen.output or "\a" in seen.output:
        wrong.append("an escape sequence reached the terminal")
    is_said = any(re.search(fault.ends.says, line) for line in seen.complaints)
    if is_said != bool(fault.ends.says):
        wrong.append(f"complaints {seen.complaints}")
    # What was stopped may have been written before.
    if fault.ends.all_but is not None and len(seen.finished) < len(ALL) - fault.ends.all_but:
        wrong.append(f"{len(seen.finished)} captures finished")
    if "left behind" in seen.output:
        wrong.append("processes are left")
    if missing := set(fault.ends.finished) - set(seen.finished):
        wrong.append(f"not finished: {sorted(missing)}")
    return "; ".join(wrong)


if __name__ == "__main__":
    main()
