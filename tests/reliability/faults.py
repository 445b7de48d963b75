"""Faults of cards, disks, machines and files, and the results that the program must have.

Each fault is done to a small flight of two good captures, `a` and `b`, and the program is run on it. `python -m
tests.reliability.faults` prints the result of each fault. test_faults.py compares it with the expected one.
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
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import numpy as np
import psutil
import tifffile

from agalign.cli import align_run as cli_run
from agalign.errors import SidecarError
from agalign.host.files import RUN_FILE
from agalign.records.sidecar_file import find_sidecars, read_sidecar

from ..conftest import raising, read_json, textured_pair, write_signed
from ..program import agalign_here

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
    watch: "Inject | None" = None
    """Done while the program runs, in a process of its own: `run`."""
    run: "subprocess.Popen[str] | None" = None
    process: dict[str, Any] = field(default_factory=dict)
    """How that process is started, where it must have one."""
    options: tuple[str, ...] = ()
    """Options that save time in what the fault does not concern."""
    undo: Callable[[], None] = lambda: None
    stopped: list[psutil.Process] = field(default_factory=list)
    """Processes that must not outlive the program."""

    def file(self, name: str = "b_nir.tif") -> Path:
        return self.folder / name

    def children(self) -> list[psutil.Process]:
        """All processes that the program has started."""
        return psutil.Process(self.run.pid).children(recursive=True)

    def workers(self) -> list[psutil.Process]:
        """The processes that do captures: the fork server starts them."""
        return [c for c in self.children() if c.ppid() != self.run.pid]

    def run_of(self, out: Path) -> list[str]:
        """Arguments of a usual run into this folder."""
        return [str(self.folder), "-o", str(out), "-j", "1", *self.options]


Inject = Callable[[Scene], object]
"""Does a fault to a flight or to a run."""


@dataclass(frozen=True)
class Fault:
    """Something that is wrong, and how a run must end."""

    name: str
    inject: Inject
    says: str = ""
    """A pattern of one of the complaints; nothing is to be complained of where it is empty."""
    code: int = 0
    finished: Sequence[str] = "ab"
    """Captures that must be aligned all the same."""
    at_least: int = 0
    """Number of captures that must be aligned, whichever: what was stopped may have been written before."""


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


def run_inside(arguments: list[str], _scene: Scene) -> tuple[int, str]:
    """In this process, which has loaded everything: (exit code, standard error)."""
    done = agalign_here(*arguments)
    return done.returncode, done.stderr


def run_outside(arguments: list[str], scene: Scene) -> tuple[int, str]:
    """In a process of its own: (exit code, standard error)."""
    given = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    given |= scene.process
    with subprocess.Popen([sys.executable, "-m", "agalign", *arguments], **given) as scene.run:
        if scene.watch is not None:
            scene.watch(scene)
        _, errors = scene.run.communicate()
    psutil.wait_procs(scene.stopped)
    return scene.run.returncode, errors or ""


# ---- what is done to files


def edited(change: Callable[[bytes], bytes]) -> Inject:
    def inject(scene: Scene) -> None:
        path = scene.file()
        path.write_bytes(change(path.read_bytes()))

    return inject


def extra(name: str, data: bytes) -> Inject:
    return lambda scene: (scene.folder / name).write_bytes(data)


def repainted(change: Callable[[np.ndarray], np.ndarray], *names: str, **tags: object) -> Inject:
    """Files of other images or tags; both files of b where none is named."""

    def inject(scene: Scene) -> None:
        for name in names or ("b_green.tif", "b_nir.tif"):
            tifffile.imwrite(scene.file(name), change(tifffile.imread(scene.file(name))), **tags)

    return inject


def tagged(*tags: tuple[int, int, int, str | bytes, bool]) -> Inject:
    return repainted(np.copy, extratags=tags)


def packet(text: str) -> Inject:
    return tagged((XMP, 1, len(text), text.encode(), True))


def xmp(values: str) -> Inject:
    return packet(_PACKET.format(values))


def directory_of(entries: list[tuple[int, int, int, bytes]], more: bytes = b"") -> bytes:
    """A little-endian TIFF of (tag, type, count, value or place), and what follows."""
    body = b"".join(struct.pack("<HHI", *head) + value.ljust(4, b"\0") for *head, value in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + struct.pack("<I", 0) + more


def many_strips(data: bytes) -> bytes:
    one, many = (struct.pack("<HHI", 273, 4, count) for count in (1, 1 << 30))
    return data.replace(one, many, 1)


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


def strange_names(scene: Scene) -> None:
    for place, name in enumerate(STRANGE_NAMES):
        write_capture(scene.folder, name, place)


def loops(scene: Scene) -> None:
    (scene.folder / "loop").symlink_to(scene.folder)
    (scene.folder / "b_nir2.tif").symlink_to(scene.folder / "b_nir2.tif")


def forbidden(path: str, mode: int = 0) -> Inject:
    """A file or folder, by default a new one, that whoever runs the program may not use.

    Root passes over permissions by two capabilities, which the program is started without.
    """

    def drop_capabilities() -> None:
        libc = ctypes.CDLL(None)
        for capability in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
            libc.prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP

    def inject(scene: Scene) -> None:
        target = scene.folder.parent / path
        if not target.exists():
            target.mkdir()
        target.chmod(mode)
        scene.process = {"preexec_fn": drop_capabilities}
        scene.undo = lambda: target.chmod(0o755)

    return inject


def read_only(scene: Scene) -> None:
    for path in scene.folder.iterdir():
        path.chmod(0o444)
    forbidden("flight", 0o555)(scene)


# ---- what is done to runs


def first_run(scene: Scene, out: Path | None = None) -> None:
    done = agalign_here(*scene.run_of(out or scene.out))
    assert done.returncode == 0, done.stderr


def patched(scene: Scene, module: ModuleType, name: str, replacement: Callable[..., object]) -> None:
    patch = mock.patch.object(module, name, replacement)
    patch.start()
    scene.undo = patch.stop


def vanishing(scene: Scene) -> None:
    """A file that vanishes when the captures are found."""
    find_captures = cli_run.find_captures
    patched(scene, cli_run, "find_captures", lambda *given: (find_captures(*given), scene.file().unlink())[0])


def killed_inside_the_input(scene: Scene) -> None:
    """An earlier run wrote below its input, and was killed before its report."""
    earlier = scene.folder / "earlier"
    first_run(scene, earlier)
    for name in ("summary.csv", "index.html"):
        (earlier / name).unlink()
    assert (earlier / RUN_FILE).is_file()


def with_sidecar(pattern: str, new: str) -> Inject:
    def inject(scene: Scene) -> None:
        first_run(scene)
        path = scene.out / "b.json"
        text = re.sub(pattern, new, path.read_text())
        if text == _DEEP:
            path.write_text(text)  # json cannot read it
        else:
            write_signed(path, text)

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


def malformed(path: Path) -> None:
    path.write_bytes(b"\x40" + bytes(7) + b"{" + b"[" * 63)


def output_is_a_folder(name: str) -> Inject:
    return lambda scene: (scene.out / name / "below").mkdir(parents=True)


def held_by_another(scene: Scene) -> None:
    scene.out.mkdir()
    code = (
        "import sys, time; from pathlib import Path; from agalign.host.output_folder import locked\n"
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


def when(ready: Inject, act: Inject, *arguments: str) -> Inject:
    """Something happens to a run once `ready` returns something true."""

    def watch(scene: Scene) -> None:
        wait_until(scene, lambda: bool(ready(scene)))
        act(scene)

    return lambda scene: vars(scene).update(arguments=[*arguments], watch=watch)


def with_captures(names: str) -> Inject:
    """More captures."""
    return lambda scene: [write_capture(scene.folder, name, place % 3) for place, name in enumerate(names)]


def when_begun(act: Inject, *arguments: str) -> Inject:
    """Something happens to a run of twelve captures once the first of them is done."""
    return both(with_captures(ALL[2:]), when(lambda scene: any(scene.out.glob("?.json")), act, *arguments))


def to_busiest(act: Callable[[psutil.Process], object]) -> Inject:
    """Is done to the worker that has computed most."""
    return lambda scene: act(max(scene.workers(), key=lambda worker: worker.cpu_times().user))


def kill_capture(scene: Scene) -> None:
    """Kill the only worker, and again when it tries the same capture once more, which it does last."""
    for finished in (1, len(ALL) - 1):
        wait_for_reports(scene, finished)
        (worker,) = scene.workers()
        before_s = worker.cpu_times().user
        wait_until(scene, lambda worker=worker, before_s=before_s: worker.cpu_times().user > before_s + 0.05)
        worker.kill()


def wait_until(scene: Scene, true: Callable[[], bool]) -> None:
    while not true():
        assert scene.run.poll() is None or true(), "the run ended before the fault"
        time.sleep(0.01)


def starve_workers(scene: Scene) -> None:
    wait_for_reports(scene)
    for worker in scene.workers():
        worker.rlimit(psutil.RLIMIT_AS, (1 << 20, 1 << 20))


def wait_for_reports(scene: Scene, captures: int = 3) -> None:
    """Wait until captures are reported: of three by two workers, one has begun its second."""

    def count() -> int:  # a sidecar without `output` is that of a capture that is being rendered
        return sum(read_json(path)["output"] is not None for path in scene.out.glob("?.json"))

    wait_until(scene, lambda: count() >= captures)


def larger(scene: Scene) -> None:
    """Images that become larger and larger: a process must ask for more memory than it keeps from those before.

    No model fits them.
    """
    learning(scene)
    for path in scene.folder.iterdir():
        times = 2 + ALL.index(path.name[0]) // 3
        tifffile.imwrite(path, np.kron(tifffile.imread(path), np.ones((times, times), np.uint16)))


def signalled(number_: int, after_s: float = 0.0) -> Inject:
    """Sent to all processes of the run, as a terminal does; none of them may be left."""

    def act(scene: Scene) -> None:
        time.sleep(after_s)
        scene.stopped = scene.children()
        os.killpg(scene.run.pid, number_)

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


def sidecar_is_a_pipe(scene: Scene) -> None:
    scene.out.mkdir()
    os.mkfifo(scene.out / "b.json")


def endless_number(scene: Scene) -> None:
    with_sidecar(r'"seconds": [0-9.]+', '"seconds": 1e309')(scene)
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
    patched(scene, fcntl, "flock", raising(OSError(errno.ENOLCK, "No locks available")))


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


_SECOND = '"file": "b.tif",\n    "band_index": 2'
_NO_NUMBERS = (
    "<Camera:PerspectiveFocalLength>nan</Camera:PerspectiveFocalLength><Camera:PrincipalPoint>1e300,inf"
    "</Camera:PrincipalPoint><DLS:HorizontalIrradiance>-5</DLS:HorizontalIrradiance>"
    "<MicaSense:RadiometricCalibration>1e300,0,0</MicaSense:RadiometricCalibration>"
)
_ENDLESS_LENS = (
    "<Camera:PerspectiveFocalLength>1e308</Camera:PerspectiveFocalLength>"
    "<Camera:PerspectiveFocalLengthUnits>mm</Camera:PerspectiveFocalLengthUnits>"
)
_LINE = np.random.default_rng(0).integers(0, 60000, (1, 100000), np.uint16)
_MAKER, _NODATA = (271, 2, 0, "Maker", True), [(42113, 2, 2, "0", True)]
_DEEP = '{"schema": "agalign/3", "bands": ' + "[" * 200_000
_POSSIBLE_NAMES = "a", "b", "-rf", "new\nline", "\x1b[31mred\a", "x" * 200
_IN_TIME = "-j", "2", "--timeout", "100"
_FILES_ELSEWHERE = '"band_files": [{"file": "../a", "bytes": 1}]'
_BOMB = (
    '<!DOCTYPE l [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY {chr(98 + k)} "{("&" + chr(97 + k) + ";") * 10}">' for k in range(8))
    + "]>"
    + _PACKET.format("<Camera:BandName>&i;</Camera:BandName>")
)
_OUTSIDE = '<!DOCTYPE l [<!ENTITY a SYSTEM "file:///etc/passwd">]>' + _PACKET.format(
    "<Camera:BandName>&a;</Camera:BandName>"
)

names_another = partial(Fault, code=3)
"""Both captures are aligned, and another file is complained of."""
loses_b = partial(Fault, code=3, finished="a")
refused = partial(Fault, code=1, finished="")
"""The run cannot begin."""
wrong_use = partial(Fault, code=2, finished="")
of_long_run = partial(Fault, code=3, finished="")
"""Captures of a run of twelve are lost."""
interrupted = partial(Fault, says="interrupted; finished", code=130, finished="")

USUAL = (
    Fault("a folder named .tif", lambda s: s.file("c_nir.tif").mkdir()),
    Fault("numbers in the tags that cannot be", both(xmp(_NO_NUMBERS), asking("--radiometry", "off"))),
    Fault("a band of another size", repainted(lambda image: image[::2, ::2], "b_nir.tif")),
    Fault("a camera model of 300 characters", both(learning, tagged(_MAKER, (272, 2, 0, "M" * 300, True)))),
    Fault("an output inside the input", lambda s: setattr(s, "out", s.folder / "out")),
    Fault("overviews that describe other files", overviews_elsewhere),
    Fault("a sidecar that names files elsewhere", with_sidecar('"band_files": \\[\\]', _FILES_ELSEWHERE)),
    Fault("the lock of a killed run", held_by_a_killed_one),
    Fault("a file system without locks", no_locks),
    names_another("a text named .tif", extra("c_nir.tif", b"hello"), "c_nir.tif: is not a TIFF"),
    names_another("a sparse image of 100,000 x 100,000", enormous, r"declares 100000 x 100000 pixels.*--max-pixels"),
    names_another(
        "a band index of 99 in a sidecar, for indices",
        both(with_sidecar(_SECOND, _SECOND.replace("2", "99")), commanding("ndvi {out} --index gndvi")),
        "b.tif: has no band 99",
    ),
    loses_b("a TIFF cut short", edited(lambda data: data[: len(data) // 2]), r"b_nir\.tif: .*copy it from the card"),
    loses_b("half of a TIFF zeros", edited(lambda data: data[:2000] + bytes(len(data) - 2000)), "^b nir: "),
    loses_b("wrong magic", edited(lambda data: b"XX" + data[2:]), "b_nir.tif: is not a TIFF, JPEG or PNG"),
    loses_b("no bytes at all", edited(lambda _: b""), "b_nir.tif: is empty"),
    loses_b("a file without permission", forbidden("flight/b_nir.tif"), r"b_nir.tif: cannot be read \(Permission"),
    loses_b("a file that vanishes during the run", vanishing, r"b_nir\.tif: does not exist"),
    loses_b("a tag that counts beyond the file", edited(many_strips), "b_nir.tif: not a readable TIFF"),
    loses_b("images of one pixel", repainted(lambda _: np.ones((1, 1), np.uint16)), "^b nir: "),
    loses_b("a band that is all nodata", repainted(np.zeros_like, "b_nir.tif", extratags=_NODATA), "^b nir: "),
    loses_b(
        "a TIFF that describes other files (VRT)", lambda s: s.file().write_text(vrt(s)), "b_nir.tif: is not a TIFF"
    ),
    loses_b("a folder where a stack belongs", output_is_a_folder("b.tif"), "b.tif: cannot be written"),
    loses_b(
        "a folder where a band's file belongs",
        both(output_is_a_folder("b_nir.tif"), asking("--layout", "bands")),
        "b_nir.tif: cannot be written",
    ),
    loses_b("images of a line of 100,000 pixels", repainted(lambda _: _LINE), "^b nir: "),
    loses_b("symlinks that lead in a circle", loops, "b_nir2.tif: cannot be read"),
    loses_b("the disk full", full_disk, "the disk is full|cannot be written"),
    refused("an output that is a file", lambda s: s.out.write_text("x"), "out: is a file"),
    refused("a malformed model file", given_model(malformed), "m.safetensors: cannot be read"),
    refused("another run in the same output", held_by_another, r"out: another run writes there \(process \d+ on "),
    refused("a pipe for a model", given_model(os.mkfifo), r"m\.safetensors: .*not a regular file"),
    wrong_use("a pipe where a sidecar belongs", sidecar_is_a_pipe, "b.json: was not written by agalign; choose"),
    wrong_use("one of GDAL's virtual paths", commanding("/vsizip/flight.zip -o {out}"), "virtual paths"),
    wrong_use("a random seed beyond 64 bits", asking("--rng-seed", "9" * 30), "--rng-seed: give"),
    wrong_use("an empty name for the folder", commanding(" -o {out}"), "the name of the folder is empty"),
)
LONG = (
    names_another("an image of 65,535 bands", extra("c.tif", declared(64, 64, 65535)), "c.tif: "),
    loses_b(
        "a sidecar of width 0, for the report",
        both(with_sidecar(r'"width": \d+', '"width": 0'), commanding("report {out}")),
        "b.json: reference.width",
    ),
    loses_b("an infinite number in a sidecar, for the report", endless_number, r"b\.json: .*finite"),
    names_another("a pipe named .tif", lambda s: os.mkfifo(s.file("c_nir.tif")), "c_nir.tif: is not a regular file"),
    Fault("a worker killed by SIGKILL", when_begun(to_busiest(psutil.Process.kill), *_IN_TIME), finished=ALL),
    interrupted("the interrupt key", when_begun(signalled(signal.SIGINT), "-j", "2")),
    Fault("the system's folder on a card", forbidden("flight/lost+found")),
    Fault("an input that may only be read", read_only),
    Fault("XMP nested 1200 deep", xmp("<a>" * 1200 + "</a>" * 1200)),
    Fault("a formula for a name", lambda s: write_capture(s.folder, '=HYPERLINK("a")', 3)),
    Fault(
        "an earlier run inside the input, killed",
        killed_inside_the_input,
        "earlier: output folders of earlier runs are",
    ),
    Fault("two captures that would write one file", colliding),
    Fault("a sidecar nested 200,000 deep", with_sidecar("(?s).+", _DEEP)),
    Fault("a terminal of ASCII", both(strange_names, with_environment(PYTHONIOENCODING="ascii"))),
    Fault("an infinite number in an earlier sidecar", both(endless_number, commanding("{folder} -o {out} -j 1"))),
    Fault("standard output closed", without_streams(1)),
    Fault("all standard streams closed", without_streams(0, 1, 2)),
    Fault("a temporary folder with a name of 150 letters", long_temporary_folder),
    Fault("a focal length of 1e308 mm in the tags", xmp(_ENDLESS_LENS)),
    Fault("names of every kind", strange_names, finished=_POSSIBLE_NAMES),
    Fault("standard error that is not read", unread_errors, finished="abcde"),
    Fault("JSON lines that are not read", both(unread_errors, asking("--log-json")), finished="abcde"),
    Fault("XML entities that multiply", packet(_BOMB), "b_nir.tif: its XMP packet .* lacks BandName"),
    Fault("an XML entity that names a file", packet(_OUTSIDE), "b_nir.tif: its XMP packet .* lacks BandName"),
    Fault(
        "XMP of five megabytes",
        xmp(f"<Camera:BandName>{'x' * 5_000_000}</Camera:BandName>"),
        "b_nir.tif: its XMP packet is damaged and lacks its end, BandName",
    ),
    names_another("a folder without permission", forbidden("flight/sub"), r"sub: cannot be looked into \(Permission"),
    names_another(
        "a system without letters beyond ASCII",
        both(strange_names, with_environment(LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")),
        "its name is not valid ASCII; rename it, or set LC_ALL=C.UTF-8",
    ),
    loses_b("a thousand tags of one value of 2 MB", long_tags, "b_nir.tif: .*declare more than 32 MB"),
    loses_b(
        "a sidecar without permission, for the report",
        both(first_run, forbidden("out/b.json"), commanding("report {out}")),
        r"b.json: cannot be read \(Permission",
    ),
    refused("an output that may not be written", forbidden("out", 0o555), "out: no permission to write there"),
    of_long_run(
        "a worker killed twice at one capture",
        both(when_begun(kill_capture, "-j", "1", "--timeout", "100"), larger),
        r"its worker process was killed \(signal 9; ",
        at_least=len(ALL) - 1,
    ),
    of_long_run(
        "memory short in the workers", both(when_begun(starve_workers, *_IN_TIME), larger), "out of memory|killed"
    ),
    of_long_run(
        "a capture that never ends",
        when_begun(to_busiest(psutil.Process.suspend), "-j", "2", "--timeout", "4"),
        "stopped after 4 s",
        at_least=len(ALL) - 1,
    ),
    interrupted("the interrupt key, workers of Dask", when_begun(signalled(signal.SIGINT), "--dask", "local")),
    interrupted(
        "the interrupt key while workers start",
        both(with_captures(ALL[2:]), when(Scene.children, signalled(signal.SIGINT), "-j", "2")),
    ),
    interrupted("SIGTERM", when_begun(signalled(signal.SIGTERM), "-j", "2"), code=143),
    interrupted(
        "SIGTERM while files are read",
        both(many_files, when(lambda s: s.children()[1:], signalled(signal.SIGTERM, 0.3), "-j", "2")),
        code=143,
    ),
    names_another("standard output full", standard_output_full, "standard output|output: No space left", code=1),
    wrong_use("a torch device without data", asking("--device", "meta"), "device 'meta' cannot be used"),
    Fault("a model of an earlier run, damaged", damaged_model),
)
"""Only in the full tests, because they take long and others are like them."""
FAULTS = USUAL + LONG


def main() -> None:
    """Print the result of each fault."""
    failed = []
    for fault in FAULTS:
        with tempfile.TemporaryDirectory() as folder:
            seen = run_fault(fault, Path(folder))
            row = (fault.name, str(seen.code), first_complaint(seen, Path(folder)))
        wrong = what_is_wrong(fault, seen)
        failed += [f"{fault.name}: {wrong}"] if wrong else []
        print(f"{seen.seconds:5.1f} s  {' | '.join(row)}  {wrong}", flush=True)
    if failed:
        raise SystemExit("\n".join(failed))


def first_complaint(seen: Seen, folder: Path) -> str:
    """The first complaint, without its remedy and without this machine's paths."""
    first = re.split("; (?!agalign needs|out of memory)", next(iter(seen.complaints), ""))[0]
    first = re.sub(rf"{re.escape(str(folder))}/(?:flight/|out/)?", "", first)
    return re.sub(r"process \d+ on [^)]+", "process … on …", first)[:160]


def what_is_wrong(fault: Fault, seen: Seen) -> str:
    """Nothing where a fault came to what it must come to."""
    is_said = any(re.search(fault.says, line) for line in seen.complaints)
    missing = sorted(set(fault.finished) - set(seen.finished))
    wrong = {
        f"exit code {seen.code}, not {fault.code}": seen.code != fault.code,
        f"a traceback: {seen.output[-1500:]}": "Traceback" in seen.output or "please report" in seen.output,
        "an escape sequence reached the terminal": "\x1b[31mred" in seen.output or "\a" in seen.output,
        f"complaints {seen.complaints}": is_said != bool(fault.says),
        "processes are left": "left behind" in seen.output,
        f"not finished: {missing}": missing,
        f"{len(seen.finished)} captures finished": len(seen.finished) < fault.at_least,
    }
    return "; ".join(what for what, is_so in wrong.items() if is_so)


if __name__ == "__main__":
    main()
