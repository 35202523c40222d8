"""Arrays of a file: written out in it, or in a CSV or NPY file beside it."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from perfcontrol._checks import InputError, fail
from perfcontrol.files.document import Place, read_text

LARGEST = 256 * 2**20  # bytes of a file beside
SUFFIXES = (".npy", ".csv")


def array_of(value: Any, place: Place) -> Any:
    """Numbers and rectangular lists as they are, files as NumPy arrays; raises InputError for anything else."""
    if isinstance(value, str):
        return _beside(value, place)
    if isinstance(value, list):
        _check(value, place)
        return value
    if isinstance(value, bool | int | float):
        return _number(value, place)
    required = "be a number, a list of numbers, or the name of a CSV or NPY file beside this one"
    raise place.fault(kind_of(value), required, "Write for example [1.0, 2.0].")


def kind_of(value: Any) -> str:
    """What a value of TOML is, in words."""
    kinds = {dict: "a table", list: "a list", str: f"the text {value!r}"[:60], bool: str(value).lower()}
    return kinds.get(type(value), f"{value!r}" if isinstance(value, int | float) else f"the time {value}")


def _number(value: Any, place: Place) -> Any:
    if value != value:
        raise place.fault("nan", "be a number", "Replace what is missing.")
    if isinstance(value, int) and abs(value) > 2**63 - 1:
        raise place.fault(f"a whole number of {len(str(abs(value)))} digits", "be below 2^63", "Write it as 1e30.")
    return value


def _check(value: list[Any], place: Place) -> tuple[int, ...]:
    """The shape of nested lists; the first element that does not fit is named."""
    if len(place.key) > 40:
        raise place.fault("lists nested that deep", "be a list of numbers, or of rows", "No array has so many axes.")
    shapes = []
    for i, item in enumerate(value):
        if isinstance(item, list):
            shapes.append(_check(item, place / i))
        elif isinstance(item, bool | int | float):
            _number(item, place / i)
            shapes.append(())
        else:
            raise (place / i).fault(kind_of(item), "be a number", "An array holds numbers only.")
        if shapes[i] != shapes[0]:
            got, before = (f"shape {shape}" if shape else "a number" for shape in (shapes[i], shapes[0]))
            raise (place / i).fault(f"{got} after {before}", "be as long as the rows before it", "Complete the row.")
    return (len(value), *(shapes[0] if shapes else ()))


def _beside(name: str, place: Place) -> np.ndarray:
    path = beside(name, place)
    try:
        array = read_npy(path) if path.suffix.lower() == ".npy" else _csv(path)
    except InputError as error:
        raise place.wrong(f"{path.name}: {error}") from None
    if np.isnan(array).any():
        at = np.argwhere(np.isnan(array))[0].tolist()
        raise place.fault(f"nan at {at} of {path.name!r}", "hold numbers only", "Replace what is missing.")
    return array


def beside(name: str, place: Place) -> Path:
    """The path of a file beside the document, and never of one elsewhere."""
    if not name.lower().endswith(SUFFIXES):
        required = "be a number, a list, or the name of a .csv or .npy file beside this one"
        raise place.fault(kind_of(name), required, "Write numbers without quotation marks.")
    folder = place.document.folder.resolve()
    try:
        path = (folder / name).resolve()
        found = path.is_file()
    except (OSError, ValueError):  # too long a name, or a null byte in it
        path, found = folder, False
    if not path.is_relative_to(folder):
        raise place.fault(repr(name), "name a file in the folder of this one", "Move or copy the file there.")
    if not found:
        raise place.fault(f"{name!r}, which is not there", "name a file beside this one", f"Looked in {folder}.")
    return path


def read_npy(path: Path) -> np.ndarray:
    """The array of an NPY file; its length is compared with what its header promises before anything is read."""
    remedy = "Write it with numpy.save(name, array)."
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise fail("path", f"{path}, which does not exist", "be a file", "Name a file that exists.") from None
    except (OSError, ValueError, EOFError, SyntaxError, MemoryError, OverflowError, TypeError) as error:
        why = str(error).split("\n")[0][:120]
        raise fail("path", f"{path.name} ({why})", "be a NumPy file of numbers", remedy) from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
        got = f"{path.name} of {getattr(array, 'dtype', 'several arrays')}"
        raise fail("path", got, "be a NumPy file of real numbers", remedy)
    if array.nbytes > LARGEST:
        got = f"{path.name} of {array.nbytes / 2**20:.0f} MiB"
        raise fail("path", got, f"be a file of at most {LARGEST / 2**20:g} MiB", "Build the problem in Python.")
    return np.array(array)


_NEXT = re.compile(r"\s*[,;\t]\s*|\s+")


def _csv(path: Path) -> np.ndarray:
    """The numbers of a text file, a row a line; one row is a vector. A first line of names is skipped, and comments."""
    rows: list[list[float]] = []
    text = read_text(path, LARGEST, "Write it with numpy.save as NPY.")
    begun = False
    for number, line in enumerate(text.split("\n"), start=1):
        cells = _NEXT.split(line.partition("#")[0].strip())
        if cells == [""]:
            continue
        values = [_cell(cell) for cell in cells]
        if not begun and not any(value is not None for value in values):
            begun = True  # names of the columns
            continue
        begun = True
        for column, value in enumerate(values, start=1):
            if value is None:
                raise InputError(
                    f"line {number}, column {column} must be a number; got {cells[column - 1]!r}. Mend it."
                )
        if rows and len(values) != len(rows[0]):
            raise InputError(f"line {number} must have {len(rows[0])} numbers, as before; got {len(values)}. Mend it.")
        rows.append([value for value in values if value is not None])
    if not rows:
        raise InputError("the file must hold numbers; got none. Write a row a line, with commas between.")
    array = np.array(rows)
    return array[0] if len(rows) == 1 else array


def _cell(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return None if value != value else value
