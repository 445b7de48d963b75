"""The output folder of a run: creation, lock, and removal of partial files of killed runs."""

import errno
import logging
import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from agalign.errors import OutputError
from agalign.host.files import path_problem, remove_partial_files, scratch_file
from agalign.host.own_files import refuse_foreign
from agalign.host.text import name_problem


def prepare_output(out: Path) -> None:
    """Create the output folder. Raises OutputError if it cannot be created or written to."""
    if problem := path_problem(out) or name_problem(out.absolute()):
        raise OutputError(problem)
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not os.access(out, os.W_OK):
            raise OutputError(f"{out}: no permission to write there; choose another folder with -o")
    except FileExistsError:
        raise OutputError(f"{out}: is a file; choose another folder with -o") from None
    except OSError as error:
        raise OutputError(f"{out}: cannot be made ({error.strerror or error}); choose another folder with -o") from None


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Create the output folder and lock it for this run. Raises OutputError, also if another run has locked it.

    Raises ConfigurationError if a file of the user has the name of the lock, which would be emptied.

    Partial files of killed processes are removed, also in the folders below it. The system releases the lock when the
    process ends, also when it is killed.
    """
    prepare_output(out)
    _check_file_system(out)
    path = out / ".agalign.lock"
    if not path.is_symlink():
        refuse_foreign(path, (b"process ",))  # as a killed process leaves it
    # The existence of a file as lock (`SoftFileLock`) would outlast a killed process.
    lock = FileLock(path, thread_local=False, fallback_to_soft=False)
    try:
        lock.acquire(blocking=False)
    except (Timeout, RuntimeError):
        raise OutputError(f"{out}: another run writes there{_lock_owner(path)}; wait for it, or choose -o") from None
    except OSError as error:
        # File systems without locks, such as NFS without its lock daemon.
        if error.errno not in (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP):
            raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from None
        logging.getLogger(__name__).warning(
            "%s: its file system has no locks; make sure that no other run writes there", out
        )
    try:
        with suppress(OSError):  # a full disk is reported where a product is written
            path.write_text(f"process {os.getpid()} on {platform.node()}", encoding="utf-8")
        remove_partial_files(out)
        yield
    finally:
        remove_partial_files(out)  # of killed workers
        with suppress(OSError):
            path.unlink(missing_ok=True)
        lock.release()


def _check_file_system(out: Path) -> None:
    """Raise OutputError if files in a folder cannot be changed at any position or renamed, as in a mounted bucket.

    Other errors, such as of a full disk, are reported where a product is written.
    """
    unsupported = errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EPERM, errno.EINVAL, errno.ESPIPE
    reason = ""
    with suppress(OutputError), scratch_file(out / "old") as old, scratch_file(out / "new") as new:
        for path in (old, new):
            path.write_bytes(b"agalign")
        try:
            with new.open("r+b") as file:
                file.seek(1)
                file.write(b"A")
            new.replace(old)
        except OSError as error:
            reason = error.strerror or "" if error.errno in unsupported else ""
    if reason:
        what = f"its file system cannot rename files or write to any position in them ({reason}), like a mounted bucket"
        raise OutputError(f"{out}: {what}; choose a local folder with -o, and copy it afterwards")


def is_full(out: Path) -> bool:
    """True if less than 1 MiB of the disk of the output folder is free."""
    try:
        return shutil.disk_usage(out).free < 1 << 20
    except OSError:
        return False


def _lock_owner(lock_file: Path) -> str:
    with suppress(OSError, UnicodeDecodeError):
        text = lock_file.read_text(encoding="utf-8")
        return f" ({text})" if text else ""
    return ""
