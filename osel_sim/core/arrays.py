"""Reading `.npz` files of others: what one claims to hold is checked against its size before anything is inflated. No objects, so no pickle.

The same check for the number of rows of a Parquet file: a column of equal values takes a few bytes, however long it is.
"""

import io
import math
import struct
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError

MAX_MEMBERS = 10_000
MAX_HEADER = 1 << 16  # bytes; numpy's own have some hundred
FREE = 64 << 20
"""So many bytes may be claimed by a file of any size: equal values compress a thousandfold."""
MAX_RATIO = 100  # beyond that
FREE_ROWS = 1_000_000
ROWS_A_BYTE = 64  # a yes or no takes a bit, and repeats of it less


def read_arrays(file: Path, what: str, content: bytes | None = None) -> dict[str, NDArray[Any]]:
    """All arrays of an `.npz` file, by name.

    Args:
        what: they are, for the error.
        content: the file's bytes, where they were read already.

    Raises:
        DataError: it is no such file, damaged, holds something else than plain arrays, or claims more than it can hold.
    """
    try:
        size = file.stat().st_size if content is None else len(content)
        with file.open("rb") if content is None else io.BytesIO(content) as source:
            with zipfile.ZipFile(source) as archive:
                _check(archive, size)
            source.seek(0)
            with np.load(source, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
    except OSError as error:
        raise DataError(f"{file}: cannot be read ({error.strerror or error})") from None
    except Exception as error:  # of damaged bytes zipfile, zlib and the parser of numpy's headers say ten different things
        raise DataError(f"{file}: not a file of {what} ({' '.join(str(error).split())[:200] or type(error).__name__})") from None


def local(file: Path) -> Path:
    """A file as Parquet's readers and writers want it: to them, a relative path that begins with `12:30/` or `a:b/` is an address."""
    return file.absolute()


def check_rows(file: Path) -> None:
    """Whether a Parquet file is large enough for its number of rows.

    Raises:
        DataError: it claims more than it can hold.
        pyarrow.ArrowException, OSError: it cannot be read.
    """
    from pyarrow.parquet import read_metadata

    rows, size = read_metadata(local(file)).num_rows, file.stat().st_size
    if rows > max(FREE_ROWS, ROWS_A_BYTE * size):
        raise DataError(f"{file}: claims {rows} rows, a file of {size} bytes cannot hold so many")


def _check(archive: zipfile.ZipFile, size: int) -> None:
    members = archive.infolist()
    if len(members) > MAX_MEMBERS or len({member.filename for member in members}) < len(members):
        raise ValueError(f"it has {len(members)} members, more than {MAX_MEMBERS} or some of the same name")
    held, claimed = sum(member.compress_size for member in members), sum(member.file_size for member in members)
    if held > size or claimed > max(FREE, MAX_RATIO * size):
        raise ValueError(f"it claims {claimed} bytes, a file of {size} bytes cannot hold so many")
    for member in members:
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or not member.filename.endswith(".npy"):
            raise ValueError(f"{member.filename[:80]!r} is no array")
        with archive.open(member) as handle:
            start, dtype, shape = _header(handle)
        if dtype.hasobject or dtype.kind not in "biufcUS":
            raise ValueError(f"{member.filename[:80]!r} holds objects of type {dtype}")
        if start + math.prod(shape) * dtype.itemsize != member.file_size:
            raise ValueError(f"{member.filename[:80]!r} claims the shape {shape} of {dtype}, and has {member.file_size} bytes")


def _header(handle: IO[bytes]) -> tuple[int, np.dtype[Any], tuple[int, ...]]:
    """Length of a member's header, type and shape of its array. No more than the header is inflated, and of that no more than a bound."""
    start = handle.read(12)
    major = start[6] if len(start) == 12 and start.startswith(b"\x93NUMPY") else 0
    if major not in (1, 2, 3):
        raise ValueError("a member is no array")
    length, begin = (struct.unpack("<H", start[8:10])[0], 10) if major == 1 else (struct.unpack("<I", start[8:12])[0], 12)
    if length > MAX_HEADER:
        raise ValueError(f"a member has a header of {length} bytes")
    whole = io.BytesIO(start + handle.read(length + begin - 12))
    version = np.lib.format.read_magic(whole)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(whole)
    return begin + length, dtype, shape
