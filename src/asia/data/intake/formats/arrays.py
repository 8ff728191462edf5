"""Files of named arrays: NumPy, MATLAB, HDF5."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from asia.data.intake.extras import need
from asia.data.intake.sheet import FileFormat, Sheet, Wanted
from asia.data.intake.tree import tree_sheets
from asia.errors import UserError

_EXPORT = "s = struct('y', z.y, 'u', z.u, 'Ts', z.Ts); save('{name}.mat', '-struct', 's', '-v7')"


class NumpyFile(FileFormat):
    """`.npz` and `.npy`."""

    name = "NumPy"
    suffixes: ClassVar[tuple[str, ...]] = (".npz", ".npy")

    def read(self, path: Path, wanted: Wanted) -> tuple[Sheet, ...]:
        """Implement `FileFormat.read`. Objects are not unpickled."""
        try:
            found: Any = np.load(path, allow_pickle=False)
            tree = {path.stem: found} if isinstance(found, np.ndarray) else dict(found.items())
        except (OSError, ValueError, EOFError, KeyError) as error:
            raise UserError(f"{path} does not read as a NumPy file: {error}") from None
        if set(tree) == {path.stem} and wanted.columns:
            tree = _named(path, np.atleast_2d(tree[path.stem]), wanted)
        return tree_sheets(path.stem, str(path), tree, wanted)


def _named(path: Path, values: Any, wanted: Wanted) -> dict[str, Any]:
    if values.shape[-1] != len(wanted.columns):
        raise UserError(
            f"{path} has {values.shape[-1]} columns, but --columns names {len(wanted.columns)}: "
            "name every column, in the order of the file"
        )
    return {name: values[:, k] for k, name in enumerate(wanted.columns)}


class Matlab(FileFormat):
    """`.mat` of every version, with structs."""

    name = "MATLAB"
    suffixes: ClassVar[tuple[str, ...]] = (".mat",)

    def read(self, path: Path, wanted: Wanted) -> tuple[Sheet, ...]:
        """Implement `FileFormat.read`."""
        from scipy.io import loadmat
        from scipy.io.matlab import MatReadError

        try:
            found: dict[str, Any] = loadmat(path, simplify_cells=True)
        except NotImplementedError:
            return tree_sheets(path.stem, str(path), _hdf5_tree(path, matlab=True), wanted)
        except (OSError, ValueError, TypeError, IndexError, MatReadError) as error:
            raise UserError(f"{path} does not read as a MAT file: {error}") from None
        tree = {k: v for k, v in found.items() if not k.startswith("__")}
        sheets = tree_sheets(path.stem, str(path), tree, wanted)
        opaque = "None" in found or "__function_workspace__" in found
        if opaque and not any(sheet.columns for sheet in sheets):
            raise _object(path, "None")
        return sheets


def _object(path: Path, name: str) -> UserError:
    what = f"the MATLAB object '{name}'" if name != "None" else "a MATLAB object"
    return UserError(
        f"{path} holds {what}, such as iddata, which only MATLAB reads: export it there with "
        + _EXPORT.format(name=path.stem + "_arrays")
    )


class Hdf5(FileFormat):
    """`.h5` and its kin."""

    name = "HDF5"
    suffixes: ClassVar[tuple[str, ...]] = (".h5", ".hdf5", ".hdf", ".he5")

    def read(self, path: Path, wanted: Wanted) -> tuple[Sheet, ...]:
        """Implement `FileFormat.read`."""
        return tree_sheets(path.stem, str(path), _hdf5_tree(path, matlab=False), wanted)


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
