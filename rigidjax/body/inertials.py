"""Read and write mass, centre of mass and inertia in robot descriptions: URDF and MuJoCo's XML."""

import warnings
import xml.etree.ElementTree as Tree
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike

from rigidjax import _checks
from rigidjax._types import Numbers
from rigidjax.body.inertia import MassProperties
from rigidjax.body.symmetric3 import PAIRS
from rigidjax.rotation import euler, quaternion

# Numbers in files are rounded: moments may break the triangle inequality by this fraction of the
# largest moment.
ROUNDED = 1e-6
_KEYS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def read_inertials(path: str | Path) -> dict[str, MassProperties]:
    """Return the bodies with inertia in a URDF or MuJoCo XML file, by name, each in its own frame.

    In both formats the element `<inertial>` is read. In URDF it contains `origin` (`xyz`, `rpy`),
    `mass` and `inertia`. In MuJoCo's format it has the attributes `mass`, `pos`, `quat`, and
    `diaginertia` or `fullinertia`; an inertia that MuJoCo would compute from geometry is not read,
    and included files are not read.

    **Arguments:** `path` of the file. **Returns** name → `MassProperties`, in the order of the
    file.

    It **warns** of each body that is left out: a body without mass, with an invalid number, with an
    orientation that MuJoCo's format gives in another form than `quat`, or with an inertia that no
    real body has. It also warns of settings by which MuJoCo changes the masses that are written in
    the file. **Raises** `ValueError` if every body is left out (the message names the file and the
    first of the bodies), and for a file that is missing or of another format.

    >>> read_inertials("missing.urdf")
    Traceback (most recent call last):
    ValueError: missing.urdf: no such file
    """
    path = _checks.file_path(path)
    root, nodes = _read(path)
    read = _from_urdf if root.tag == "robot" else _from_mujoco
    bodies: dict[str, MassProperties] = {}
    faults = []
    for name, node in nodes.items():
        inertial = node.find("inertial")
        if inertial is not None:
            try:
                bodies[name] = read(inertial)
            except ValueError as error:
                faults.append(f"{path}: body {name!r}: {error}")
    if faults and not bodies:
        raise ValueError(faults[0])
    for words in [f"{fault}; this body is left out" for fault in faults]:
        warnings.warn(words, stacklevel=2)
    for compiler in root.iter("compiler"):
        for key, unchanged in _UNCHANGED.items():
            value = compiler.get(key)
            if value is not None and not _equals_one_of(value, unchanged):
                words = f'{key}="{value}": MuJoCo {_CHANGES[key]}; read as written'
                warnings.warn(f"{path}: {words}", stacklevel=2)
    if next(root.iter("include"), None) is not None:
        warnings.warn(f"{path}: <include>: bodies in other files are not read", stacklevel=2)
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


def write_inertials(
    path: str | Path, bodies: Mapping[str, MassProperties], source: str | Path
) -> None:
    """Copy a URDF or MuJoCo XML file, with the inertials of `bodies` instead of the inertials in
    the file.

    **Arguments:** `path` of the new file; `bodies` name → `MassProperties`, in the frames of the
    file's links or bodies; `source` the file to copy; the rest of the file does not change.
    **Raises:** `ValueError` if the file `source` is missing, is of another format, or has two
    bodies of one name, and for a name in `bodies` that is not in the file.

    >>> write_inertials("new.urdf", {}, "old.urdf")
    Traceback (most recent call last):
    ValueError: bodies: wanted at least one name → MassProperties, got none
    """
    path, source = _checks.file_path(path), _checks.file_path(source, "source")
    _checks.require_instance(
        bodies, Mapping, "bodies", requirement="a dict of name → MassProperties"
    )
    if not bodies:
        raise ValueError("bodies: wanted at least one name → MassProperties, got none")
    root, nodes = _read(source)
    write = _write_to_urdf if root.tag == "robot" else _write_to_mujoco
    for name, body in bodies.items():
        _checks.require_unbatched_instance(body, MassProperties, f"bodies[{name!r}]")
        if name not in nodes:
            raise ValueError(f"{source}: no body {name!r}; there are {', '.join(nodes)}")
        inertial = nodes[name].find("inertial")
        if inertial is None:
            inertial = Tree.SubElement(nodes[name], "inertial")
        inertial.clear()
        write(inertial, body)
    Tree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


class Description(NamedTuple):
    """Hold the elements of a robot description."""

    root: Tree.Element  # `robot` (URDF) or `mujoco`
    nodes: dict[str, Tree.Element]  # the links or bodies by name


def _read(path: Path) -> Description:
    """Read a robot description, or raise a `ValueError` for a file that is missing, of another
    format, or with two bodies of one name.
    """
    if not path.exists():
        raise ValueError(f"{path}: no such file")
    try:
        root = Tree.parse(path).getroot()
    except (Tree.ParseError, OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read as XML ({error})") from None
    if root.tag not in ("robot", "mujoco"):
        raise ValueError(f"{path}: wanted a URDF (robot) or MuJoCo file, got <{root.tag}>")
    tag = "link" if root.tag == "robot" else "body"
    nodes = root.findall("link") if tag == "link" else list(root.iter("body"))
    names = [node.get("name", f"{tag} {index}") for index, node in enumerate(nodes)]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(f"{path}: two bodies are called {twice[0]!r}; wanted one name each")
    return Description(root, dict(zip(names, nodes, strict=True)))


def _from_urdf(inertial: Tree.Element) -> MassProperties:
    """Return the body of an `<inertial>` element of a URDF file, in the frame of its link."""
    origin, mass, inertia = (inertial.find(tag) for tag in ("origin", "mass", "inertia"))
    if mass is None or inertia is None:
        missing = "<mass>" if mass is None else "<inertia>"
        raise ValueError(f"wanted a <mass> and an <inertia> in <inertial>, got no {missing}")
    com = _read_numbers(origin, "xyz", 3, [0.0] * 3)
    # The three angles in the attribute `rpy` of URDF are turns about fixed axes: roll about x, then
    # pitch about y, then yaw about z.
    rotation = euler.to_matrix(_read_numbers(origin, "rpy", 3, [0.0] * 3), "xyz")
    diagonal = [_read_numbers(inertia, key, 1)[0] for key in _KEYS[:3]]
    others = [_read_numbers(inertia, key, 1, [0.0])[0] for key in _KEYS[3:]]
    return _body(_read_numbers(mass, "value", 1)[0], com, rotation, [*diagonal, *others])


def _from_mujoco(inertial: Tree.Element) -> MassProperties:
    """Return the body of an `<inertial>` element of a MuJoCo file, in the frame of its `<body>`."""
    other = [key for key in ("axisangle", "xyaxes", "zaxis", "euler") if key in inertial.attrib]
    if other:
        raise ValueError(f"its inertial is turned by {other[0]}; wanted quat")
    q = quaternion.normalise(_read_numbers(inertial, "quat", 4, [1.0, 0.0, 0.0, 0.0]))
    if "fullinertia" in inertial.attrib:
        six = _read_numbers(inertial, "fullinertia", 6)
    else:
        six = [*_read_numbers(inertial, "diaginertia", 3), 0.0, 0.0, 0.0]
    com = _read_numbers(inertial, "pos", 3, [0.0] * 3)
    return _body(_read_numbers(inertial, "mass", 1)[0], com, quaternion.to_matrix(q), six)


def _body(
    mass: float, com: np.ndarray, rotation: ArrayLike, inertia_entries: Sequence[float] | np.ndarray
) -> MassProperties:
    """Return a body from its mass, kg, centre of mass, m, rotation to the body frame, and inertia
    entries xx, yy, zz, xy, xz, yz, kg m².

    Moments that break the triangle inequality I1 + I2 ≥ I3 only by rounding (about 1e-6 of I3) are
    corrected.
    """
    xx, yy, zz, xy, xz, yz = inertia_entries
    rotation = np.asarray(rotation, float)
    tensor = rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
    if not mass > 0:
        raise ValueError(f"wanted a positive mass, got {mass:g}")
    second = 0.5 * np.trace(tensor) * np.eye(3) - tensor
    least = np.linalg.eigvalsh(second)[0]
    moments = np.linalg.eigvalsh(tensor)
    if not moments[2] > 0 or least < -ROUNDED * moments[2]:
        shown = ", ".join(f"{moment:.6g}" for moment in moments)
        raise ValueError(f"wanted moments of a body, I1 ≥ 0 and I1 + I2 ≥ I3, got {shown}")
    if least < 0:
        second = second - least * np.eye(3)
    return MassProperties(mass, com, second)


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


def _text(numbers: ArrayLike | Numbers) -> str:
    """Return numbers with all their digits, separated by spaces."""
    return " ".join(repr(float(number)) for number in np.ravel(numbers))


def _write_to_urdf(inertial: Tree.Element, body: MassProperties) -> None:
    """Write a body into an empty `<inertial>` element of a URDF file."""
    tensor = np.asarray(body.inertia.tensor)
    Tree.SubElement(inertial, "origin", xyz=_text(body.com), rpy="0 0 0")
    Tree.SubElement(inertial, "mass", value=_text(body.mass))
    entries = {key: _text(tensor[at]) for key, at in zip(_KEYS, PAIRS, strict=True)}
    Tree.SubElement(inertial, "inertia", entries)


def _write_to_mujoco(inertial: Tree.Element, body: MassProperties) -> None:
    """Write a body into an empty `<inertial>` element of a MuJoCo file."""
    tensor = np.asarray(body.inertia.tensor)
    inertial.set("mass", _text(body.mass))
    inertial.set("pos", _text(body.com))
    inertial.set("fullinertia", _text([tensor[at] for at in PAIRS]))
