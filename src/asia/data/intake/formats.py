"""File formats: arrays (NumPy, MATLAB, HDF5), Arrow, Excel, data loggers, ROS bags, text."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, LiteralString
from zipfile import BadZipFile

import numpy as np

from asia._plugins import library
from asia.data.intake.sheet import (
    Cells,
    Column,
    FileFormat,
    FileTable,
    Wanted,
    as_objects,
    find_channels,
    find_column,
    header_names,
    named_table,
)
from asia.data.intake.text import Text, number
from asia.data.intake.timestamps import may_be_time, time_column
from asia.errors import UserError

# Libraries that come with an extra.


def need(module: LiteralString, path: Path, extra: str) -> Any:
    """A library that comes with an extra. Raises UserError that says how to get it."""
    try:
        return library(module)
    except ImportError:
        raise UserError(
            f"{path} needs the package {module.partition('.')[0]}: "
            f"pip install '.[{extra}]' in a clone of ASIA"
        ) from None


# Files of named arrays: NumPy, MATLAB, HDF5.


_STEPS = ("ts", "dt", "sampling_time", "sample_time", "samplingtime", "fs", "sampling_rate")
_RATES = ("fs", "sampling_rate")


def _tree_sheets(
    name: str, where: str, tree: Mapping[str, Any], wanted: Wanted
) -> tuple[FileTable, ...]:
    """The folders of the tree that hold all wanted channels, one sheet each; the whole tree where
    none does.

    A matrix of n columns is n channels, called `name1` to `namen`; a channel is known by its own
    name, where that is the only one, and by its path.

    Args:
        tree: arrays, mappings and lists of mappings
    """
    found = list(_matching_tables(name, where, tree, wanted))
    return tuple(found) or (_tree_table(name, where, tree),)


def _matching_tables(
    name: str, where: str, tree: Mapping[str, Any], wanted: Wanted
) -> Iterator[FileTable]:
    sheet = _tree_table(name, where, tree)
    if all(find_channels(sheet.columns, n) for n in wanted.names):
        yield sheet
        return
    for key, node in tree.items():
        if isinstance(node, Mapping):
            yield from _matching_tables(key, f"{where}, {key}", node, wanted)
        elif isinstance(node, list) and all(isinstance(n, Mapping) for n in node):
            for k, one in enumerate(node, 1):
                yield from _matching_tables(f"{key}{k}", f"{where}, {key}({k})", one, wanted)


def _tree_table(name: str, where: str, tree: Mapping[str, Any]) -> FileTable:
    leaves = dict(_arrays_in(tree, ""))
    short = Counter(path.rpartition(".")[2] for path in leaves)
    columns: dict[str, Column] = {}
    step = None
    for path, values in leaves.items():
        bare = path.rpartition(".")[2]
        label = bare if short[bare] == 1 else path
        if values.size == 1:
            if bare.casefold() in _STEPS and values.dtype.kind in "fiu":
                value = float(values.flat[0])
                step = 1.0 / value if bare.casefold() in _RATES else value
            continue
        for key, cells in _matrix_columns(label, values):
            columns[key] = Column(cells, matrix="" if key == label else label)
    lengths = Counter(len(c.cells) for c in columns.values())
    longest = max(lengths, key=lambda n: (lengths[n], n), default=0)
    kept = {k: c for k, c in columns.items() if len(c.cells) == longest}
    return FileTable(name, kept, step if step is not None and step > 0 else None, where)


def _arrays_in(tree: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Cells]]:
    for key, node in tree.items():
        path = f"{prefix}{key}"
        if isinstance(node, Mapping):
            yield from _arrays_in(node, f"{path}.")
        elif isinstance(node, np.ndarray) and node.dtype.kind in "fiubcMOUS" and node.ndim <= 3:
            yield path, np.asarray(node)
        elif isinstance(node, float | int | np.number):
            yield path, np.asarray(node, dtype=np.float64)


def _matrix_columns(label: str, values: Cells) -> Sequence[tuple[str, Cells]]:
    """A matrix as its columns; time runs along the longer side."""
    values = np.squeeze(values)
    if values.dtype.kind in "US":
        values = values.astype(object)
    if values.ndim == 1:
        return [(label, values)]
    if values.ndim != 2:
        return []
    if values.shape[0] < values.shape[1]:
        values = values.T
    return [(f"{label}{k + 1}", values[:, k]) for k in range(values.shape[1])]


class NumpyFile(FileFormat):
    """`.npz` and `.npy`."""

    name = "NumPy"
    suffixes: ClassVar[tuple[str, ...]] = (".npz", ".npy")

    def read(self, path: Path, wanted: Wanted) -> tuple[FileTable, ...]:
        """Implement `FileFormat.read`. Objects are not unpickled."""
        try:
            found: Any = np.load(path, allow_pickle=False)
            tree = {path.stem: found} if isinstance(found, np.ndarray) else dict(found.items())
        except (OSError, ValueError, EOFError, KeyError) as error:
            raise UserError(f"{path} does not read as a NumPy file: {error}") from None
        if set(tree) == {path.stem} and wanted.columns:
            values = np.atleast_2d(tree[path.stem])
            if values.shape[-1] != len(wanted.columns):
                raise UserError(
                    f"{path} has {values.shape[-1]} columns, but --columns names "
                    f"{len(wanted.columns)}: name every column, in the order of the file"
                )
            tree = {name: values[:, k] for k, name in enumerate(wanted.columns)}
        return _tree_sheets(path.stem, str(path), tree, wanted)


class Matlab(FileFormat):
    """`.mat` of every version, with structs."""

    name = "MATLAB"
    suffixes: ClassVar[tuple[str, ...]] = (".mat",)

    def read(self, path: Path, wanted: Wanted) -> tuple[FileTable, ...]:
        from scipy.io import loadmat
        from scipy.io.matlab import MatReadError

        try:
            found: dict[str, Any] = loadmat(path, simplify_cells=True)
        except NotImplementedError:
            return _tree_sheets(path.stem, str(path), _hdf5_tree(path, matlab=True), wanted)
        except (OSError, ValueError, TypeError, IndexError, MatReadError) as error:
            raise UserError(f"{path} does not read as a MAT file: {error}") from None
        tree = {k: v for k, v in found.items() if not k.startswith("__")}
        sheets = _tree_sheets(path.stem, str(path), tree, wanted)
        opaque = "None" in found or "__function_workspace__" in found
        if opaque and not any(sheet.columns for sheet in sheets):
            raise _object(path, "None")
        return sheets


def _object(path: Path, name: str) -> UserError:
    what = f"the MATLAB object '{name}'" if name != "None" else "a MATLAB object"
    return UserError(
        f"{path} holds {what}, such as iddata, which only MATLAB reads: export it there with "
        "s = struct('y', z.y, 'u', z.u, 'Ts', z.Ts); "
        f"save('{path.stem}_arrays.mat', '-struct', 's', '-v7')"
    )


class Hdf5(FileFormat):
    """`.h5` and its kin."""

    name = "HDF5"
    suffixes: ClassVar[tuple[str, ...]] = (".h5", ".hdf5", ".hdf", ".he5")

    def read(self, path: Path, wanted: Wanted) -> tuple[FileTable, ...]:
        return _tree_sheets(path.stem, str(path), _hdf5_tree(path, matlab=False), wanted)


def _hdf5_tree(path: Path, *, matlab: bool) -> dict[str, Any]:
    h5py = need("h5py", path, "intake")
    try:
        with h5py.File(path, "r") as file:
            return _folder(h5py, file, file, path, matlab=matlab)
    except OSError as error:
        raise UserError(f"{path} does not read as HDF5: {error}") from None


def _folder(h5py: Any, file: Any, group: Any, path: Path, *, matlab: bool) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, node in group.items():
        if key.startswith("#"):
            continue
        if "MATLAB_object_decode" in node.attrs:
            raise _object(path, key)
        if isinstance(node, h5py.Group):
            inner = _folder(h5py, file, node, path, matlab=matlab)
            found[key] = _unzipped(inner) if matlab else inner
        else:
            found[key] = _dataset(h5py, file, node, path, matlab=matlab)
    return found


def _dataset(h5py: Any, file: Any, node: Any, path: Path, *, matlab: bool) -> Any:
    if node.dtype.names:
        whole = node[()]
        return {name: np.asarray(whole[name]) for name in node.dtype.names}
    if node.dtype == h5py.ref_dtype:
        inner = [file[one] for one in np.ravel(node[()])]
        return [
            _folder(h5py, file, one, path, matlab=matlab)
            if isinstance(one, h5py.Group)
            else _dataset(h5py, file, one, path, matlab=matlab)
            for one in inner
        ]
    values = np.asarray(node[()])
    if values.dtype.kind in "OS":
        return np.array(
            [v.decode("utf-8", "replace") if isinstance(v, bytes) else v for v in values.flat],
            dtype=object,
        )
    # MATLAB stores columns first: its T x n arrays are n x T in the file.
    return values.T if matlab else values


def _unzipped(fields: Mapping[str, Any]) -> Any:
    """A struct array, stored as one list a field, as one mapping an element."""
    lists = [v for v in fields.values() if isinstance(v, list)]
    if not lists or len(lists) < len(fields) or len({len(v) for v in lists}) != 1:
        return fields
    return [dict(zip(fields, row, strict=True)) for row in zip(*fields.values(), strict=True)]


# Parquet, Arrow and Feather.


_ROWS = 262_144


class Arrow(FileFormat):
    """Read batch by batch, and only the requested columns, to save memory."""

    name = "Parquet and Arrow"
    suffixes: ClassVar[tuple[str, ...]] = (".parquet", ".pq", ".arrow", ".feather", ".ipc")

    def read(self, path: Path, wanted: Wanted) -> tuple[FileTable, ...]:
        pyarrow = need("pyarrow", path, "intake")
        try:
            if path.suffix.lower() in (".parquet", ".pq"):
                file: Any = need("pyarrow.parquet", path, "intake").ParquetFile(path)
                schema, rows, read_batches = (
                    file.schema_arrow,
                    file.metadata.num_rows,
                    partial(file.iter_batches, batch_size=_ROWS),
                )
            else:
                dataset: Any = need("pyarrow.dataset", path, "intake")
                file = dataset.dataset(path, format="feather")
                schema, rows, read_batches = (
                    file.schema,
                    file.count_rows(),
                    partial(file.to_batches, batch_size=_ROWS, use_threads=False),
                )
        except (OSError, pyarrow.lib.ArrowException) as error:
            raise UserError(f"{path} does not read as Parquet or Arrow: {error}") from None
        names_of_all: list[str] = schema.names
        kinds: dict[str, str] = {
            n: _kind(t)
            for n, t in zip(names_of_all, schema.types, strict=True)
            if names_of_all.count(n) == 1
        }
        empty = {n: Column(np.zeros(0, kind)) for n, kind in kinds.items()}
        twice = {n: ("",) * names_of_all.count(n) for n in names_of_all if n not in kinds}
        names = {find_column(list(empty), n) for n in wanted.names}
        names |= {n for n in empty if may_be_time(n)} if wanted.names else set()
        names.add(time_column(FileTable(path.stem, empty, where=str(path)), wanted))
        if not wanted.names or not all(find_column(list(empty), n) for n in wanted.names):
            return (FileTable(path.stem, empty, where=str(path), repeated=twice),)
        cells = {n: np.empty(rows, dtype=kinds[n]) for n in empty if n in names}
        done = 0
        for batch in read_batches(columns=list(cells)):
            for name, column in cells.items():
                column[done : done + batch.num_rows] = _cells(batch.column(name), kinds[name])
            done += batch.num_rows
            if rows > _ROWS:
                wanted.progress(f"{path.name}: {done / rows:.0%} of {rows} rows")
        columns = {n: Column(column) for n, column in cells.items()}
        return (FileTable(path.stem, columns, where=str(path)),)


def _kind(arrow_type: object) -> str:
    text = str(arrow_type)
    if text.startswith(("timestamp", "date")):
        return "datetime64[ns]"
    return "float64" if text.startswith(("int", "uint", "float", "double", "half")) else "object"


def _cells(array: Any, kind: str) -> Cells:
    if kind == "object":
        return as_objects(array.to_pylist())
    return np.asarray(array.to_numpy(zero_copy_only=False)).astype(kind)


# Excel.


class Excel(FileFormat):
    """Each worksheet that has the wanted columns is a record."""

    name = "Excel"
    suffixes: ClassVar[tuple[str, ...]] = (".xlsx", ".xlsm")

    def read(self, path: Path, wanted: Wanted) -> tuple[FileTable, ...]:
        openpyxl = need("openpyxl", path, "intake")
        try:
            book: Any = openpyxl.load_workbook(path, read_only=True, data_only=True)
        except (OSError, KeyError, ValueError, BadZipFile) as error:
            raise UserError(f"{path} does not read as an Excel workbook: {error}") from None
        many = len(book.worksheets) > 1
        found: list[FileTable] = []
        for page in book.worksheets:
            rows = [
                row
                for row in page.iter_rows(values_only=True)
                if any(cell is not None and str(cell).strip() for cell in row)
            ]
            name = page.title if many else path.stem
            where = f"{path}, worksheet {page.title}" if many else str(path)
            first = next((k for k, row in enumerate(rows) if not _is_head(row)), None)
            if first is not None:
                found.append(_worksheet(rows, first, name, where, wanted))
        book.close()
        if not found:
            raise UserError(f"{path} is empty: expected a header row, then numbers")
        full = [s for s in found if all(find_column(list(s.columns), n) for n in wanted.names)]
        return tuple(full or found[:1])


def _is_head(row: tuple[Any, ...]) -> bool:
    cells = [c for c in row if c is not None]
    return all(isinstance(c, str) and number(c) is None for c in cells)


def _worksheet(
    rows: list[tuple[Any, ...]], first: int, name: str, where: str, wanted: Wanted
) -> FileTable:
    """Make a table of the rows of a worksheet; `first` is the first one with data."""
    width = max(len(row) for row in rows[first:])
    units, groups = [""] * width, list[str]()
    if wanted.columns:
        labels = list(wanted.columns)
        if len(labels) != width:
            raise UserError(f"{where} has {width} columns, but --columns names {len(labels)}")
    else:
        heads = [
            ["" if c is None else str(c).strip() for c in (*row, *[None] * width)[:width]]
            for row in rows[max(first - 4, 0) : first]
        ]
        if not heads:
            raise UserError(
                f"{where}: the first row holds numbers: add a header row with the column names, or "
                "give --columns"
            )
        labels, units, groups = header_names(heads, wanted.names)
    cells = zip(*((*row, *[None] * (width - len(row))) for row in rows[first:]), strict=True)
    columns = [Column(as_objects(c), u) for u, c in zip(units, cells, strict=True)]
    return named_table(FileTable(name, {}, None, where, first + 1), labels, columns, groups)


# Data loggers: TDMS and MDF4. Channels may have times of their own.


class Tdms(FileFormat):
    """LabVIEW. Each group that has the wanted channels is a record."""

    name = "TDMS"
    suffixes: ClassVar[tuple[str, ...]] = (".tdms",)

    def read(self, path: Path, wanted: Wanted) -> tuple[FileTable, ...]:
        nptdms = need("nptdms", path, "loggers")
        try:
            file: Any = nptdms.TdmsFile.read(path)
        except (OSError, ValueError, KeyError) as error:
            raise UserError(f"{path} does not read as TDMS: {error}") from None
        groups: list[FileTable] = []
        for group in file.groups():
            columns: dict[str, Column] = {}
            for channel in (c for c in group.channels() if len(c)):
                timed = "wf_increment" in channel.properties
                columns[channel.name] = Column(
                    np.asarray(channel[:]),
                    str(channel.properties.get("unit_string", "")),
                    np.asarray(channel.time_track(), dtype=np.float64) if timed else None,
                )
            groups.append(FileTable(group.name, columns, where=f"{path}, group {group.name}"))
        full = [s for s in groups if all(find_column(list(s.columns), n) for n in wanted.names)]
        if len(full) > 1 and wanted.names:
            return tuple(full)
        if full:
            return (FileTable(path.stem, full[0].columns, where=str(path)),)
        pairs = [(n, c) for s in groups for n, c in s.columns.items()]
        every = [s.name for s in groups for _ in s.columns]
        table = FileTable(path.stem, {}, where=str(path))
        return (named_table(table, [n for n, _ in pairs], [c for _, c in pairs], every),)


class Mdf(FileFormat):
    """MDF 3 and 4 of automotive loggers. Groups have rasters of their own."""

    name = "MDF"
    suffixes: ClassVar[tuple[str, ...]] = (".mf4", ".mdf", ".dat4")

    def read(self, path: Path, wanted: Wanted) -> tuple[FileTable, ...]:
        asammdf = need("asammdf", path, "loggers")

        def refused(*_: object, **__: object) -> None:
            raise UserError(
                f"{path}: a channel has a formula with more than numbers in it, which is not "
                "computed: export the channel with physical values"
            )

        # Where numexpr refuses a formula, the library would run it as Python code.
        asammdf.blocks.v4_blocks.lambdify = asammdf.blocks.v2_v3_blocks.lambdify = refused
        try:
            file: Any = asammdf.MDF(path)
        except (OSError, ValueError, asammdf.blocks.utils.MdfException) as error:
            raise UserError(f"{path} does not read as MDF: {error}") from None
        with file:
            known = [n for n in file.channels_db if n not in ("time", "t")]
            columns = {n: Column(np.zeros(0)) for n in known}
            for name in {find_column(known, n) for n in wanted.names} - {None}:
                place = file.channels_db[name]
                if len(place) > 1:
                    raise UserError(
                        f"{path}: {len(place)} channels are named '{name}': export the one that "
                        "you mean under a name of its own"
                    )
                signal = file.get(name, group=place[0][0], index=place[0][1])
                columns[name] = Column(
                    np.asarray(signal.samples),
                    str(signal.unit or ""),
                    np.asarray(signal.timestamps, dtype=np.float64),
                )
        return (FileTable(path.stem, columns, where=str(path)),)


# Bags of ROS 1 and ROS 2.


class Rosbag(FileFormat):
    """A channel is `/topic/field`, or `/topic/field/2` in an array. Its times are those of the
    messages' headers, where all have one, and of their receipt otherwise or with `--time
    receipt`."""

    name = "rosbag"
    suffixes: ClassVar[tuple[str, ...]] = (".bag", ".db3", ".mcap", "/")

    def read(self, path: Path, wanted: Wanted) -> tuple[FileTable, ...]:
        highlevel: Any = need("rosbags.highlevel", path, "ros")
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            raise UserError(f"{path} is a folder without a metadata.yaml: name a file or a bag")
        place = path.parent if path.suffix in (".db3", ".mcap") else path
        typesys: Any = need("rosbags.typesys", path, "ros")
        store: Any = typesys.get_typestore(typesys.Stores.LATEST)
        try:
            with highlevel.AnyReader([place], default_typestore=store) as reader:
                columns = _columns(reader, wanted)
        except (OSError, highlevel.AnyReaderError) as error:
            raise UserError(f"{path} does not read as a bag: {error}") from None
        return (FileTable(path.stem, columns, where=str(path)),)


def _columns(reader: Any, wanted: Wanted) -> dict[str, Column]:
    values: dict[str, list[float]] = {}
    stamps: dict[str, list[float]] = {}
    topics = [
        c
        for c in reader.connections
        if any(name.startswith(c.topic) or find_column([c.topic], name) for name in wanted.names)
    ]
    first = int(reader.start_time)
    for connection, received, raw in reader.messages(connections=topics or reader.connections):
        message = reader.deserialize(raw, connection.msgtype)
        when: int = received
        header: Any = getattr(message, "header", None)
        if header is not None and wanted.time != "receipt":
            when = int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec) or received
        for name, value in _fields(message, connection.topic):
            values.setdefault(name, []).append(value)
            stamps.setdefault(name, []).append((when - first) * 1e-9)
    return {
        name: Column(np.array(found), "", np.round(np.array(stamps[name], dtype=np.float64), 9))
        for name, found in values.items()
    }


def _fields(value: Any, name: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, bool | int | float | np.number):
        yield name, float(value)
    elif isinstance(value, np.ndarray | list) and len(value) <= 64:
        for k, one in enumerate(value):
            yield from _fields(one, f"{name}/{k}")
    else:
        for key in getattr(value, "__dataclass_fields__", {}):
            if key not in ("header", "__msgtype__"):
                yield from _fields(getattr(value, key), f"{name}/{key}")


# Table of file formats and the choice of the format for a file.


FORMATS: tuple[type[FileFormat], ...] = (
    Text, Matlab, Hdf5, Arrow, NumpyFile, Excel, Tdms, Mdf, Rosbag,
)  # fmt: skip


def file_format(path: Path) -> FileFormat:
    """The format of a file, by the end of its name. Raises UserError."""
    if not path.exists():
        raise UserError(f"no such file: {path}")
    suffix = "/" if path.is_dir() else path.suffix.lower()
    found = next((f for f in FORMATS if suffix in f.suffixes), None)
    if found is None:
        known = ", ".join(s for f in FORMATS for s in f.suffixes if s != "/")
        what = "a folder" if suffix == "/" else f"a file of the kind '{suffix}'"
        raise UserError(f"{path} is {what}, which ASIA does not read: expected one of {known}")
    return found()
