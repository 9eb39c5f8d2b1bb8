"""Read and write mass, centre of mass and inertia in the files of simulators: URDF, MuJoCo's XML,
TOML and JSON. What is written changes the numbers of a body, and no other byte of the file.
"""

import itertools
import json
import re
import tomllib
import warnings
import xml.etree.ElementTree as Tree
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.parsers import expat

import numpy as np

from rigidjax import _checks
from rigidjax.body.inertia import Body, Inertia, MassProperties
from rigidjax.body.symmetric3 import PAIRS

# Numbers in files are rounded: moments may break the triangle inequality by this fraction of the
# largest moment.
ROUNDED = 1e-6
# A number that differs from that in the file by no more than this many units of round-off is left
# as the file has it.
_SAME = 16.0
_KEYS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_TURNS: dict[str, int] = {"quat": 4, "axisangle": 4, "xyaxes": 6, "zaxis": 3, "euler": 3}
# What the numbers of a body are called in TOML and JSON, such as the `params.toml` of crazyflow.
_MASS, _COM = ("mass", "m"), ("com", "center_of_mass", "centre_of_mass")
_TENSOR = ("J", "inertia", "inertia_tensor", "I")
_LOAD = {".toml": tomllib.loads, ".json": json.loads}
_START_TAG = re.compile(rb"""<([^\s/>]+)(\s+[^\s=/>]+\s*=\s*("[^"]*"|'[^']*'))*\s*/?>""")
_NUMBER = re.compile(r"#.*|(?P<number>[-+]?\.?\d[\w.+-]*)")


def read_inertials(path: str | Path) -> dict[str, MassProperties]:
    """Return the bodies with inertia in a file of a simulator, by name, each in its own frame.

    - URDF: the `<inertial>` of each `<link>`: `origin` (`xyz`, `rpy`), `mass` and `inertia`.
    - MuJoCo's XML: the `<inertial>` of each `<body>`: `mass`, `pos`, an orientation, and
      `diaginertia` or `fullinertia`. An inertia that MuJoCo would compute from geometry is not
      read, and included files are not read.
    - TOML (the `params.toml` of crazyflow) and JSON: each table with a `mass` and a `J` (or
      `inertia`, `inertia_tensor`, `I`), (3, 3) or three moments, about the centre of mass, and
      perhaps a `com`. A table in a table is called `outer.inner`, the outermost one `body`.

    Products of inertia are components of the tensor: `ixy = −∫ x y dm`.

    **Arguments:** `path` of the file. **Returns** name → `MassProperties`, in the order of the
    file.

    It **warns** of each body that is left out: a body without mass, with an invalid number, or with
    an inertia that no real body has. It also warns of settings by which MuJoCo changes the masses
    that are written in the file. **Raises** `ValueError` if every body is left out (the message
    names the file and the first of the bodies), and for a file that is missing or of another
    format.

    >>> read_inertials("missing.urdf")
    Traceback (most recent call last):
    ValueError: missing.urdf: no such file
    """
    file = open_file(path)
    bodies: dict[str, MassProperties] = {}
    faults = []
    for name in file.nodes:
        try:
            if file.has_inertia(name):
                bodies[name] = file.body(name)
        except ValueError as error:
            faults.append(str(error))
    if faults and not bodies:
        raise ValueError(faults[0])
    for words in [*(f"{fault}; this body is left out" for fault in faults), *file.remarks()]:
        warnings.warn(words, stacklevel=2)
    return bodies


# The keys are attributes of the element `<compiler>` in a MuJoCo file. `_UNCHANGED` has the values
# with which MuJoCo takes masses and inertias as they are written; `_CHANGES` says what MuJoCo does
# with any other value.
_UNCHANGED = {
    "inertiafromgeom": ("false", "auto"), "settotalmass": ("-1", "0"), "balanceinertia": ("false",),
    "boundmass": ("0",), "boundinertia": ("0",), "coordinate": ("local",),
}  # fmt: skip
_CHANGES = {
    "inertiafromgeom": "takes all masses and inertias from the geometry instead",
    "settotalmass": "scales all masses and inertias to this total mass",
    "balanceinertia": "replaces the moments of what is no real body by their mean",
    "boundmass": "raises smaller masses to this value",
    "boundinertia": "raises smaller moments to this value",
    "coordinate": "reads places and orientations in the frame of the world",
}


def _equals_one_of(value: str, options: Sequence[str]) -> bool:
    """Return whether an attribute equals one of some texts; numbers are compared as numbers."""
    try:
        return float(value) in map(float, options)
    except ValueError:
        return value.strip() in options


def write_inertials(path: str | Path, bodies: Mapping[str, Body], source: str | Path) -> None:
    """Copy a file of a simulator, with the mass, centre of mass and inertia of `bodies` instead of
    those in the file.

    A body is written in the form that it has in the file: in the axes of the `<inertial>` of a
    URDF; for MuJoCo as `fullinertia`, or as `diaginertia` with a `quat`. All other bytes of the
    file stay as they are, and a number that the body already has in the file stays, too.

    **Arguments:**

    - `path`: the new file, which may be `source`.
    - `bodies`: name → `MassProperties`, in the frames of the file's links or bodies. An `Inertia`
      (kg m², about the centre of mass) leaves the mass and the centre of mass of the file. An
      `Inertia` of arbitrary scale (free motion shows ratios only) leaves the sum of the three
      moments of the file, too, and a warning says so.
    - `source`: the file to copy, in a format that `read_inertials` names.

    It **warns** of a centre of mass for which the file has no place. **Raises** `ValueError` if the
    file `source` is missing, is of another format, or has two bodies of one name; for a name in
    `bodies` that is not in the file; for an `Inertia` if the file has no mass of this body; and for
    products of inertia if the file has place for three moments only.

    >>> write_inertials("new.urdf", {}, "old.urdf")
    Traceback (most recent call last):
    ValueError: bodies: wanted at least one name → MassProperties, got none
    """
    path = _checks.file_path(path)
    _checks.require_instance(
        bodies, Mapping, "bodies", requirement="a dict of name → MassProperties or Inertia"
    )
    if not bodies:
        raise ValueError("bodies: wanted at least one name → MassProperties, got none")
    file = open_file(source, "source")
    for name, body in bodies.items():
        _checks.require_unbatched_instance(body, (MassProperties, Inertia), f"bodies[{name!r}]")
        file = _parse(file.path, file.with_body(file.named(name), body))
    path.write_bytes(file.text)


class Stated(NamedTuple):
    """Hold the numbers of a body as a file states them."""

    mass: Any
    com: np.ndarray
    tensor: np.ndarray  # about the centre of mass, in axes of its own
    turn: np.ndarray = np.eye(3)  # from these axes to those of the body


_NOTHING = Stated(np.nan, np.full(3, np.nan), np.full((3, 3), np.nan))


class File(NamedTuple):
    """Hold the text of a file and its bodies: elements of XML, or tables."""

    path: Path
    text: bytes
    root: Any
    nodes: dict[str, Any]  # the bodies by name
    places: dict[Tree.Element, int]  # where in the text each element begins

    def named(self, name: str | None) -> str:
        """Return the `name`, or that of the only body; raise `ValueError` if there is none."""
        inertial = [one for one in self.nodes if self.has_inertia(one)] or list(self.nodes)
        if name is None and len(inertial) == 1:
            return inertial[0]
        if name in self.nodes:
            return name
        there = ", ".join(self.nodes) or "none (in TOML and JSON a body has a mass and a J)"
        wanted = "wanted --body NAME" if name is None else f"no body {name!r}"
        raise ValueError(f"{self.path}: {wanted}; there are {there}")

    def has_inertia(self, name: str) -> bool:
        """Return whether the file has an inertia of a body."""
        node = self.nodes[name]
        return isinstance(node, dict) or node.find("inertial") is not None

    def body(self, name: str) -> MassProperties:
        """Return a body; raise `ValueError` if it has no inertia, or one of no real body."""
        try:
            return _body(self.stated(name))
        except ValueError as error:
            raise ValueError(f"{self.path}: body {name!r}: {error}") from None

    def stated(self, name: str) -> Stated:
        """Return the numbers of a body, which may be those of no real body."""
        node = self.nodes[name]
        if not self.has_inertia(name):
            raise ValueError("wanted an <inertial>, got none")
        if isinstance(node, dict):
            return _from_table(node)
        read = _from_urdf if self.root.tag == "robot" else _from_mujoco
        return read(node.find("inertial"), self.compiler)

    @property
    def compiler(self) -> dict[str, str]:
        """Return the settings of MuJoCo's compiler."""
        elements = [] if isinstance(self.root, dict) else self.root.iter("compiler")
        return {key: value for one in elements for key, value in one.attrib.items()}

    def remarks(self) -> Iterator[str]:
        """Yield what MuJoCo takes in another way than it is written."""
        for key, value in self.compiler.items():
            if key in _UNCHANGED and not _equals_one_of(value, _UNCHANGED[key]):
                yield f'{self.path}: {key}="{value}": MuJoCo {_CHANGES[key]}; read as written'
        if not isinstance(self.root, dict) and next(self.root.iter("include"), None) is not None:
            yield f"{self.path}: <include>: bodies in other files are not read"

    def with_body(self, name: str, body: Body) -> bytes:
        """Return the text of the file with another body."""
        node, old = self.nodes[name], _NOTHING
        try:
            old = self.stated(name)
        except ValueError as error:
            if isinstance(body, Inertia):
                words = "its mass must stand in the file, since an Inertia has none"
                raise ValueError(f"{self.path}: body {name!r}: {error}; {words}") from None
        new = _completed(f"{self.path}: body {name!r}", body, old)
        if isinstance(node, dict):
            return self._with_table(name, new, old)
        inertial, tags, children = node.find("inertial"), {}, b""
        if self.root.tag == "robot":
            own, inner = {}, _urdf_numbers(new, old)
        else:
            full = old is _NOTHING or "fullinertia" in inertial.attrib
            own, inner = _mujoco_numbers(new, old, full), {}
        for tag, numbers in inner.items():
            element = None if inertial is None else inertial.find(tag)
            if element is not None:
                tags[element] = _with_numbers(self._tag(element), numbers)
            elif numbers:
                children += _with_numbers(f"<{tag}/>".encode(), numbers)
        holder = b"<inertial/>" if inertial is None else self._tag(inertial)
        holder = _with_child(_with_numbers(holder, own), children)
        if inertial is None:
            tags[node] = _with_child(self._tag(node), holder)
        else:
            tags[inertial] = holder
        text = self.text
        for element in sorted(tags, key=self.places.__getitem__, reverse=True):
            start = self.places[element]
            text = text[:start] + tags[element] + text[start + len(self._tag(element)) :]
        return text

    def _tag(self, element: Tree.Element) -> bytes:
        """Return the start tag of an element as it is written."""
        found = _START_TAG.match(self.text, self.places[element])
        if found is None:
            raise ValueError(f"{self.path}: wanted a file in UTF-8, to change numbers in it")
        return found[0]

    def _with_table(self, name: str, new: Stated, old: Stated) -> bytes:
        """Return the text of TOML or JSON with other numbers in a table."""
        text, load = self.text.decode(), _LOAD[self.path.suffix.lower()]
        for keys, value, before in zip((_MASS, _COM, _TENSOR), new, old, strict=False):
            key = next((key for key in keys if key in self.nodes[name]), None)
            numbers = _settled(value, before)
            if key is None and numbers.any():
                words = f"has no place for the centre of mass, which is at {_text(numbers)} m"
                warnings.warn(f"{self.path}: body {name!r} {words}", stacklevel=4)
            elif key is not None and np.shape(self.nodes[name][key]) == (3,) != np.shape(numbers):
                if (numbers - np.diag(np.diag(numbers))).any():
                    words = "has three moments: no place for products of inertia; give it (3, 3)"
                    raise ValueError(f"{self.path}: body {name!r}: {key} {words}")
                numbers = np.diag(numbers)
            if key is not None:
                text = _replaced(text, load, name, key, numbers)
        return text.encode()


def open_file(path: str | Path, name: str = "path") -> File:
    """Return an open file; raise `ValueError` for one that is missing or of another format."""
    path = _checks.file_path(path, name)
    if not path.exists():
        raise ValueError(f"{path}: no such file")
    try:
        return _parse(path, path.read_bytes())
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error})") from None


def _parse(path: Path, text: bytes) -> File:
    """Return the bodies in a text; raise `ValueError` for two of one name."""
    load = _LOAD.get(path.suffix.lower())
    try:
        if load is not None:
            root = load(text.decode())
            return File(path, text, root, dict(_tables(root)), {})
        root, places = _elements(text)
    except (expat.ExpatError, ValueError) as error:
        kind = "XML" if load is None else path.suffix[1:].upper()
        raise ValueError(f"{path}: cannot be read as {kind} ({error})") from None
    if root.tag not in ("robot", "mujoco"):
        raise ValueError(
            f"{path}: wanted a URDF (robot) or MuJoCo file, .toml or .json, got <{root.tag}>"
        )
    tag = "link" if root.tag == "robot" else "body"
    nodes = root.findall("link") if tag == "link" else list(root.iter("body"))
    names = [node.get("name", f"{tag} {index}") for index, node in enumerate(nodes)]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(f"{path}: two bodies are called {twice[0]!r}; wanted one name each")
    return File(path, text, root, dict(zip(names, nodes, strict=True)), places)


def _elements(text: bytes) -> tuple[Tree.Element, dict[Tree.Element, int]]:
    """Return the root element of XML, and where each element begins."""
    builder, parser, places = Tree.TreeBuilder(), expat.ParserCreate(), {}

    def start(tag: str, attributes: dict[str, str]) -> None:
        places[builder.start(tag, attributes)] = parser.CurrentByteIndex

    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    parser.Parse(text, True)
    return builder.close(), places


def _tables(node: Any, outer: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each table that has a mass and an inertia, with its name."""
    if isinstance(node, dict):
        if node.keys() & set(_MASS) and node.keys() & set(_TENSOR):
            yield outer or "body", node
        for key, inner in node.items():
            yield from _tables(inner, f"{outer}.{key}".strip("."))


def _from_table(table: dict[str, Any]) -> Stated:
    """Return the numbers of a table of TOML or JSON."""
    found = []
    for keys, shapes in ((_MASS, [()]), (_COM, [(3,)]), (_TENSOR, [(3, 3), (3,)])):
        key = next((key for key in keys if key in table), None)
        try:
            numbers = np.array(np.zeros(shapes[0]) if key is None else table[key], float)
        except (TypeError, ValueError):
            numbers = np.array(np.nan)
        if numbers.shape not in shapes or not np.isfinite(numbers).all():
            wanted, got = " or ".join(map(str, shapes)), table.get(str(key))
            raise ValueError(f"{key}: wanted finite numbers of shape {wanted}, got {got!r}")
        found.append(numbers)
    mass, com, tensor = found
    return Stated(mass, com, np.diag(tensor) if tensor.ndim == 1 else tensor)


def _from_urdf(inertial: Tree.Element, _: Any) -> Stated:
    """Return the numbers of an `<inertial>` of a URDF file."""
    from scipy.spatial.transform import Rotation

    origin, mass, inertia = (inertial.find(tag) for tag in ("origin", "mass", "inertia"))
    if mass is None or inertia is None:
        missing = "<mass>" if mass is None else "<inertia>"
        raise ValueError(f"wanted a <mass> and an <inertia> in <inertial>, got no {missing}")
    com = _read_numbers(origin, "xyz", 3, [0.0] * 3)
    # The three angles in the attribute `rpy` of URDF are turns about fixed axes: roll about x, then
    # pitch about y, then yaw about z.
    turn = Rotation.from_euler("xyz", _read_numbers(origin, "rpy", 3, [0.0] * 3)).as_matrix()
    diagonal = [_read_numbers(inertia, key, 1)[0] for key in _KEYS[:3]]
    others = [_read_numbers(inertia, key, 1, [0.0])[0] for key in _KEYS[3:]]
    tensor = _symmetric([*diagonal, *others])
    return Stated(_read_numbers(mass, "value", 1)[0], com, tensor, turn)


def _from_mujoco(inertial: Tree.Element, compiler: dict[str, str]) -> Stated:
    """Return the numbers of an `<inertial>` of a MuJoCo file."""
    if "fullinertia" in inertial.attrib:
        six = _read_numbers(inertial, "fullinertia", 6)
    else:
        six = [*_read_numbers(inertial, "diaginertia", 3), 0.0, 0.0, 0.0]
    com = _read_numbers(inertial, "pos", 3, [0.0] * 3)
    mass = _read_numbers(inertial, "mass", 1)[0]
    return Stated(mass, com, _symmetric(six), _turn_of_mujoco(inertial, compiler))


def _turn_of_mujoco(inertial: Tree.Element, compiler: dict[str, str]) -> np.ndarray:
    """Return the rotation that one of MuJoCo's five kinds of orientation describes."""
    from scipy.spatial.transform import Rotation

    kind = next((kind for kind in _TURNS if kind in inertial.attrib), None)
    if kind is None:
        return np.eye(3)
    numbers, degrees = _read_numbers(inertial, kind, _TURNS[kind]), compiler.get("angle")
    vectors = {"quat": numbers[None], "axisangle": numbers[None, :3]}.get(kind)
    vectors = numbers.reshape(-1, 3) if vectors is None else vectors
    if kind != "euler" and not np.linalg.norm(vectors, axis=1).all():
        raise ValueError(f"{kind}: wanted a direction, got one of length zero")
    if kind == "quat":
        turn = Rotation.from_quat(numbers, scalar_first=True)
    elif kind == "euler":
        # MuJoCo's small letters are axes that turn with the body, which are SciPy's capitals.
        sequence = compiler.get("eulerseq", "xyz").swapcase()
        turn = Rotation.from_euler(sequence, numbers, degrees != "radian")
    elif kind == "axisangle":
        axis = numbers[:3] / np.linalg.norm(numbers[:3])
        turn = Rotation.from_rotvec(numbers[3] * axis, degrees != "radian")
    elif kind == "zaxis":
        turn = Rotation.align_vectors(numbers[None], np.eye(3)[2:])[0]
    else:
        both = numbers.reshape(2, 3) / np.linalg.norm(numbers.reshape(2, 3), axis=1)[:, None]
        turn = Rotation.align_vectors(both, np.eye(3)[:2], weights=[np.inf, 1.0])[0]
    return turn.as_matrix()


def _symmetric(six: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the symmetric tensor of its components xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _body(stated: Stated) -> MassProperties:
    """Return the body of the numbers in a file.

    Moments that break the triangle inequality I1 + I2 ≥ I3 only by rounding (about 1e-6 of I3) are
    corrected.
    """
    mass, tensor = float(stated.mass), stated.turn @ stated.tensor @ stated.turn.T
    if not mass > 0:
        raise ValueError(f"wanted a positive mass, got {mass:g}")
    if (abs(tensor - tensor.T) > ROUNDED * abs(tensor).max()).any():
        raise ValueError(f"wanted a symmetric inertia, got {tensor.tolist()}")
    second = 0.5 * np.trace(tensor) * np.eye(3) - 0.5 * (tensor + tensor.T)
    least = np.linalg.eigvalsh(second)[0]
    moments = np.linalg.eigvalsh(tensor)
    if not moments[2] > 0 or least < -ROUNDED * moments[2]:
        shown = ", ".join(f"{moment:.6g}" for moment in moments)
        raise ValueError(f"wanted moments of a body, I1 ≥ 0 and I1 + I2 ≥ I3, got {shown}")
    if least < 0:
        second = second - least * np.eye(3)
    return MassProperties(mass, stated.com, second)


def _read_numbers(
    element: Tree.Element | None, key: str, count: int, default: list[float] | None = None
) -> np.ndarray:
    """Return the `count` finite numbers in an attribute of an element, else the `default`."""
    text = None if element is None else element.get(key)
    if text is None:
        if default is None:
            raise ValueError(f"wanted an attribute {key}, got none")
        return np.array(default)
    try:
        numbers = np.array([float(part) for part in text.split()])
    except ValueError:
        raise ValueError(f"{key}: wanted numbers, got {text!r}") from None
    if numbers.size != count or not np.isfinite(numbers).all():
        raise ValueError(f"{key}: wanted {count} finite numbers, got {text!r}")
    return numbers


def _text(numbers: Any) -> str:
    """Return numbers with all their digits, separated by spaces."""
    return " ".join(repr(float(number)) for number in np.ravel(numbers))


def _completed(place: str, body: Body, old: Stated) -> Stated:
    """Return the numbers of a body in its own axes; an `Inertia` has mass, centre and, of ratios,
    the sum of the moments from the file.
    """
    if isinstance(body, MassProperties):
        tensor = np.asarray(body.inertia.tensor)
        return Stated(np.asarray(body.mass), np.asarray(body.com), tensor)
    tensor = np.asarray(body.tensor)
    if body.scale is not None:
        total = float(np.trace(old.tensor))
        if not total > 0:
            raise ValueError(f"{place}: wanted its moments beside ratios, got none")
        tensor = (tensor * (total / np.trace(tensor))).astype(tensor.dtype)
        words = f"the sum of the moments stays that of the file, {total:.6g} kg m²"
        warnings.warn(f"{place}: only ratios are known: {words}", stacklevel=4)
    return Stated(old.mass, old.com, tensor)


def _settled(new: Any, old: Any) -> np.ndarray:
    """Return numbers in float64, those of the file where they differ by round-off only."""
    new = np.asarray(new)
    # The text of a float32 has its own digits, not those of the float64 beside it.
    numbers = np.array([float(str(number)) for number in new.ravel()]).reshape(new.shape)
    same = abs(numbers - old) <= _SAME * np.finfo(new.dtype).eps * abs(numbers).max()
    return np.where(same, old, numbers)


def _in_axes_of(old: Stated, new: Stated) -> np.ndarray:
    """Return the new tensor in the axes in which the file has the old one."""
    turned = old.turn.T @ new.tensor @ old.turn
    return _settled((0.5 * (turned + turned.T)).astype(new.tensor.dtype), old.tensor)


def _changed(pairs: Iterable[tuple[str, Any, Any]]) -> dict[str, Any]:
    """Return the numbers by key that are not those of the file."""
    return {key: new for key, new, old in pairs if not np.array_equal(new, old)}


def _urdf_numbers(new: Stated, old: Stated) -> dict[str, dict[str, Any]]:
    """Return the attributes to change in the children of an `<inertial>` of a URDF file."""
    tensor, mass, com = _in_axes_of(old, new), *map(_settled, new[:2], old[:2])
    inertia = [(key, tensor[at], old.tensor[at]) for key, at in zip(_KEYS, PAIRS, strict=True)]
    turn = np.zeros(3), 0.0 * old.com  # NaN if the file has no turn to keep
    return {
        "origin": _changed([("xyz", com, old.com), ("rpy", *turn)]),
        "mass": _changed([("value", mass, old.mass)]),
        "inertia": _changed(inertia),
    }


def _mujoco_numbers(new: Stated, old: Stated, full: bool) -> dict[str, Any]:
    """Return the attributes to change in an `<inertial>` of a MuJoCo file; `None` takes one away.

    Principal axes are numbered and directed as near as possible to those of the file.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.transform import Rotation

    tensor, mass, com = _in_axes_of(old, new), *map(_settled, new[:2], old[:2])
    pairs = [("mass", mass, old.mass), ("pos", com, old.com)]
    gone = dict.fromkeys(_TURNS)
    if full:
        six = tuple(np.array(PAIRS).T)
        gone = gone | {"diaginertia": None} if old is _NOTHING else {}
        return _changed([*pairs, ("fullinertia", tensor[six], old.tensor[six])]) | gone
    moments, axes = np.diag(tensor), np.eye(3)
    if (tensor - np.diag(moments)).any():
        moments, axes = np.linalg.eigh(tensor)
        order = linear_sum_assignment(-abs(axes))[1]
        moments, axes = moments[order], axes[:, order]
        axes = axes * np.sign(np.diag(axes))
        axes[:, np.argmin(np.diag(axes))] *= np.linalg.det(axes)
        quat = Rotation.from_matrix(old.turn @ axes).as_quat(scalar_first=True)
        return _changed([*pairs, ("diaginertia", moments, np.nan)]) | gone | {"quat": quat}
    return _changed([*pairs, ("diaginertia", moments, np.diag(old.tensor))])


def _with_numbers(tag: bytes, attributes: dict[str, Any]) -> bytes:
    """Return a start tag with other numbers in its attributes, and without those of `None`."""
    for key, numbers in attributes.items():
        where = rf"""(\s+{key}\s*=\s*)(["'])[^"']*["']""".encode()
        new = b"" if numbers is None else rb"\g<1>\g<2>%b\g<2>" % _text(numbers).encode()
        tag, found = re.subn(where, new, tag, count=1)
        if not found and numbers is not None:
            end = re.search(rb"\s*/?>$", tag)[0]  # pyright: ignore
            tag = tag.removesuffix(end) + f' {key}="{_text(numbers)}"'.encode() + end
    return tag


def _with_child(tag: bytes, child: bytes) -> bytes:
    """Return a start tag with a child behind it; an empty element gets an end tag."""
    if child and tag.endswith(b"/>"):
        return tag[:-2].rstrip() + b">" + child + b"</" + _START_TAG.match(tag)[1] + b">"  # pyright: ignore
    return tag + child


def _replaced(text: str, load: Any, name: str, key: str, numbers: np.ndarray) -> str:
    """Return TOML or JSON with other numbers in one place of a table, found by trial: the text is
    right if it is read as the old one but for these numbers.
    """
    wanted = load(text)
    dict(_tables(wanted))[name][key] = numbers.tolist()
    if load(text) == wanted:
        return text
    for start in re.finditer(rf"\b{key}\b[\"']?\s*[=:]", text):
        places = (m for m in _NUMBER.finditer(text, start.end()) if m["number"])
        pairs = zip(numbers.ravel(), itertools.islice(places, numbers.size), strict=False)
        draft = text
        try:
            for number, place in reversed(list(pairs)):
                if float(place[0]) != number:
                    draft = draft[: place.start()] + repr(float(number)) + draft[place.end() :]
            if load(draft) == wanted:
                return draft
        except ValueError:
            continue
    raise ValueError(f"body {name!r}: {key}: wanted plain numbers in the text")
