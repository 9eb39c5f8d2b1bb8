"""Inertials from and to files of simulators: frames, round trips, what no body has."""

import json
import re
import tomllib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rigidjax as rj

TENSOR = np.array([[3.0, 0.1, -0.2], [0.1, 2.5, 0.3], [-0.2, 0.3, 1.5]])
URDF = """<?xml version="1.0"?>
<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial>
      <origin xyz="0.1 -0.2 0.3" rpy="0.4 -0.5 0.6"/>
      <mass value="2.0"/>
      <inertia ixx="3.0" ixy="0.1" ixz="-0.2" iyy="2.5" iyz="0.3" izz="1.5"/>
    </inertial>
    <visual><geometry><box size="1 1 1"/></geometry></visual>
  </link>
</robot>
"""
MUJOCO = """<mujoco><worldbody>
  <body name="upper">
    <inertial mass="2.0" pos="0.1 -0.2 0.3" quat="0.8 0.2 -0.4 0.4" diaginertia="3.0 2.5 1.5"/>
    <body name="lower">
      <inertial mass="1.0" pos="0 0 0" fullinertia="3.0 2.5 1.5 0.1 -0.2 0.3"/>
      <geom size="1"/>
    </body>
    <body name="hand"><geom size="1"/></body>
  </body>
</worldbody></mujoco>
"""


def written(tmp_path, text, name="robot.xml"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_a_urdf_is_read_in_the_frame_of_its_link(tmp_path):
    found = rj.body.read_inertials(written(tmp_path, URDF))
    assert list(found) == ["upper"]
    turn = Rotation.from_euler("xyz", [0.4, -0.5, 0.6]).as_matrix()
    np.testing.assert_allclose(found["upper"].inertia.tensor, turn @ TENSOR @ turn.T, rtol=1e-12)
    np.testing.assert_allclose(found["upper"].com, [0.1, -0.2, 0.3])
    np.testing.assert_allclose(found["upper"].mass, 2.0)


def test_mujoco_is_read_in_the_frame_of_its_body(tmp_path):
    found = rj.body.read_inertials(written(tmp_path, MUJOCO))
    assert list(found) == ["upper", "lower"]
    turn = Rotation.from_quat([0.2, -0.4, 0.4, 0.8]).as_matrix()
    wanted = turn @ np.diag([3.0, 2.5, 1.5]) @ turn.T
    np.testing.assert_allclose(found["upper"].inertia.tensor, wanted, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(found["lower"].inertia.tensor, TENSOR, rtol=1e-12)


@pytest.mark.parametrize(("text", "name"), [(URDF, "base"), (MUJOCO, "hand")])
def test_what_is_written_is_read_and_the_rest_stays(tmp_path, text, name):
    source, path = written(tmp_path, text), tmp_path / "new.xml"
    body = rj.shapes.box(1.5, [0.1, 0.2, 0.3]).shift([0.01, 0.02, 0.03])
    rj.body.write_inertials(path, {name: body, "upper": body}, source)
    before, after = rj.body.read_inertials(source), rj.body.read_inertials(path)
    assert set(after) == {*before, name}
    for key in (name, "upper"):
        np.testing.assert_allclose(after[key].com, body.com, rtol=1e-15)
        np.testing.assert_allclose(after[key].second_moment, body.second_moment, atol=1e-17)
    assert "size" in path.read_text()


MISTAKES = [
    (URDF.replace('"1.5"', '"9.5"'), "body 'upper': wanted moments of a body"),
    (URDF.replace('"2.0"', '"0"'), "body 'upper': wanted a positive mass, got 0"),
    (URDF.replace('"2.5"', '"two"'), "body 'upper': iyy: wanted numbers, got 'two'"),
    (URDF.replace("0.1 -0.2 0.3", "0.1 -0.2"), "xyz: wanted 3 finite numbers, got '0.1 -0.2'"),
    (URDF.replace("base", "upper"), "two bodies are called 'upper'"),
    (
        MUJOCO.replace("quat", "euler").replace('mass="1.0"', 'mass="-1"'),
        "body 'upper': euler: wanted 3 finite numbers, got '0.8 0.2 -0.4 0.4'",
    ),
    ("<world/>", "wanted a URDF .robot. or MuJoCo file, .toml or .json, got <world>"),
    ("<robot", "cannot be read as XML"),
]


@pytest.mark.parametrize(("text", "words"), MISTAKES)
def test_mistakes_are_told_with_file_and_body(tmp_path, text, words):
    with pytest.raises(ValueError, match=f"robot.xml: .*{words}"):
        rj.body.read_inertials(written(tmp_path, text))


def test_a_name_that_is_not_there(tmp_path):
    source = written(tmp_path, URDF)
    with pytest.raises(ValueError, match="no body 'hand'; there are base, upper"):
        rj.body.write_inertials(tmp_path / "x", {"hand": rj.shapes.box(1.0, [1.0, 1, 1])}, source)


ROBOT = """<robot name="arm">
  <link name="world"/>
  {links}
</robot>
"""
LINK = """<link name="{name}"><inertial>
  <origin xyz="0 0 0.2"/><mass value="{mass}"/>
  <inertia ixx="{moment}" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/>
</inertial></link>"""
BAD = {
    "tool": (dict(mass="0", moment="0.01"), "wanted a positive mass, got 0"),
    "camera": (
        dict(mass="0.1", moment="0.09"),
        "wanted moments of a body, I1 ≥ 0 and I1 + I2 ≥ I3, got 0.02, 0.02, 0.09",
    ),
    "cover": (dict(mass="1e-3 kg", moment="0.01"), "value: wanted numbers, got '1e-3 kg'"),
    "plate": (dict(mass="0.1", moment="nan"), "ixx: wanted 1 finite numbers, got 'nan'"),
}


def test_the_links_of_a_whole_robot_are_read_and_bad_ones_named(tmp_path):
    good = {f"link {k}": dict(mass=f"{k}.5", moment="0.03") for k in range(1, 4)}
    links = list(good.items()) + [(name, how) for name, (how, _) in BAD.items()]
    links.insert(1, links.pop())
    text = ROBOT.format(links="\n".join(LINK.format(name=name, **how) for name, how in links))
    path = written(tmp_path, text)
    with pytest.warns(UserWarning, match="left out") as said:
        found = rj.body.read_inertials(path)
    assert list(found) == list(good)
    np.testing.assert_allclose([body.mass for body in found.values()], [1.5, 2.5, 3.5])
    words = {str(one.message) for one in said}
    assert len(words) == len(said) == len(BAD)
    for name, (_, why) in BAD.items():
        (line,) = (line for line in words if line.startswith(f"{path}: body {name!r}: {why}"))
        assert line.endswith("; this body is left out")


SETTINGS = {
    'inertiafromgeom="true"': "takes all masses and inertias from the geometry instead",
    'settotalmass="12"': "scales all masses and inertias to this total mass",
    'balanceinertia="true"': "replaces the moments of what is no real body by their mean",
    'boundmass="0.5"': "raises smaller masses to this value",
    'boundinertia="1e-3"': "raises smaller moments to this value",
    'coordinate="global"': "reads places and orientations in the frame of the world",
}


@pytest.mark.parametrize("setting", SETTINGS)
def test_settings_by_which_mujoco_has_other_masses_are_told(setting, tmp_path):
    path = written(tmp_path, MUJOCO.replace("<mujoco>", f"<mujoco><compiler {setting}/>"))
    with pytest.warns(UserWarning, match="MuJoCo") as said:
        found = rj.body.read_inertials(path)
    assert list(found) == ["upper", "lower"]
    assert [str(one.message) for one in said] == [
        f"{path}: {setting}: MuJoCo {SETTINGS[setting]}; read as written"
    ]


def test_settings_that_change_nothing_are_not_told(tmp_path):
    usual = 'inertiafromgeom="auto" settotalmass="-1.0" balanceinertia="false" boundmass="0"'
    path = written(
        tmp_path, MUJOCO.replace("<mujoco>", f'<mujoco><compiler {usual} angle="radian"/>')
    )
    assert list(rj.body.read_inertials(path)) == ["upper", "lower"]


def test_files_that_are_included_are_told(tmp_path):
    path = written(tmp_path, MUJOCO.replace("<mujoco>", '<mujoco><include file="arm.xml"/>'))
    with pytest.warns(UserWarning, match="<include>: bodies in other files are not read"):
        rj.body.read_inertials(path)


# A file as people keep it: comments, tabs, both quotes, another order, a carriage return.
TIDY = {
    "robot.urdf": """<?xml version='1.0' encoding="utf-8"?>\r
<!-- <link name="upper"/> Größe -->
<robot name="arm" xmlns:xacro="http://ros.org/wiki/xacro">
\t<link name="base"/><link   name='upper' >
\t  <!-- <mass value="7"/> -->
\t  <inertial><mass
\t      value = '2.00'   /> <!-- kg -->
\t    <inertia iyy="2.5" izz="1.50" ixy="0.1"  ixz='-0.2' iyz="0.3" ixx="3." />
\t    <origin rpy="0.4 -.5 6e-1" xyz='0.1 -0.20 0.3'/></inertial></link>
</robot>
""",
    "turned.xml": """<mujoco><compiler angle="radian"/><!-- quat="1 0 0 0" --><worldbody>
  <body name="upper" ><inertial diaginertia='3.0 2.50 1.5' pos="0.1 -0.2 0.3" mass="2.00"
      euler="0.3 -0.2 1.1"/></body><body name="base"/>
</worldbody></mujoco>
""",
    "full.xml": MUJOCO.replace('name="upper"', 'name="base"').replace("lower", "upper"),
    "params.toml": """# J = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
[base]
J = [[25e-6, 0.0,   0.0], [0.0,   28e-6, 0.0], [0.0,   0.0,   49e-6]]
mass = 0.04338
[upper]
gravity_vec = [0.0, 0.0, -9.81]
mass = 2.00                       # kg
J = [  # TODO 3.0
    [3.0, 0.1,  -0.2],   # kg m²
    [1.0e-1, 2.5, 0.3],
    [-0.2, 0.3, 1.50]
]
com = [0.1, -0.2, 0.3]
""",
    "model.json": """{"name": "J", "J": 3, "base": {"I": [1, 1, 1.0], "m": 1},
  "upper": {"mass": 2.00, "com": [0.1,-0.2,0.3],\t"note": "inertia: 3",
    "inertia": [[3.0, 0.1, -0.2], [0.1, 2.5, 0.3], [-0.2, 0.3, 1.50]]}}
""",
}


def tidy(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(TIDY[name].encode())
    return path


@pytest.mark.parametrize("name", TIDY)
def test_a_body_that_is_written_back_changes_no_byte(tmp_path, name):
    path = tidy(tmp_path, name)
    body = rj.body.read_inertials(path)["upper"]
    np.testing.assert_allclose(np.trace(body.inertia.tensor), 7.0, rtol=1e-15)
    rj.body.write_inertials(path, {"upper": body}, path)
    rj.body.write_inertials(path, {"upper": body.inertia}, path)
    assert path.read_bytes() == TIDY[name].encode()


def possible(rng):
    """A body of any size, with products of inertia of both signs."""
    root = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-3, 1)
    return rj.MassProperties(10.0 ** rng.uniform(-3, 2), rng.normal(size=3), root @ root.T)


def without_numbers(text):
    return re.sub(rb"[-+]?\.?\d[\w.+-]*", b"0", text)


@pytest.mark.parametrize("name", TIDY)
def test_what_is_written_is_read_to_round_off_and_the_rest_stays(tmp_path, name):
    source, path, rng = tidy(tmp_path, name), tmp_path / ("new" + name), np.random.default_rng(4)
    others, wanted = rj.body.read_inertials(source), TIDY[name].encode()
    if name == "turned.xml":  # other axes are a quaternion
        wanted = wanted.replace(b'\n      euler="0.3 -0.2 1.1"/>', b' quat="1 0 0 0"/>')
    for _ in range(20):
        body = possible(rng)
        rj.body.write_inertials(path, {"upper": body}, source)
        found = rj.body.read_inertials(path)
        assert list(found) == list(others)
        new = found.pop("upper")
        assert (new.mass, *new.com) == (body.mass, *body.com)
        largest = body.inertia.moments[2]
        off = abs(new.inertia.tensor - body.inertia.tensor).max() / largest
        assert off < 2e-15
        for key, other in found.items():
            np.testing.assert_array_equal(other.second_moment, others[key].second_moment)
        assert without_numbers(path.read_bytes()) == without_numbers(wanted)


# What MuJoCo 4.0 has in `body_iquat` for diaginertia="3.0 2.5 1.5" (its tensor in body axes).
ORIENTATIONS = {
    'euler="30 40 50"': [2.208054877632585, 2.731745634057865, 2.060199488309551, 0.460398093240690,
                         -0.420229635832963, 0.265064911251823],
    'axisangle="1 2 3 50"': [2.487105190051149, 2.718600016759426, 1.794294793189425,
                             0.247387478513402, -0.535256409621655, -0.065680821009779],
    'xyaxes="1 2 3 0.3 1 0"': [1.633006161341167, 2.561613411663563, 2.805380426995272,
                               0.342241008740507, 0.227503940392606, 0.178177389310789],
    'zaxis="1 2 3"': [2.889713967546536, 2.217428889596322, 1.892857142857143, -0.180928810054384,
                      -0.342618782479256, -0.417976323046087],
}  # fmt: skip


@pytest.mark.parametrize("how", ORIENTATIONS)
def test_orientations_are_those_of_mujoco(tmp_path, how):
    text = MUJOCO.replace('quat="0.8 0.2 -0.4 0.4"', how)
    tensor = np.asarray(rj.body.read_inertials(written(tmp_path, text))["upper"].inertia.tensor)
    six = [tensor[at] for at in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(six, ORIENTATIONS[how], atol=1e-14)
    # Another body has other axes: one orientation, in the form of a quaternion, is left.
    path = tmp_path / "new.xml"
    rj.body.write_inertials(path, {"upper": rj.Inertia(TENSOR)}, tmp_path / "robot.xml")
    assert how.split("=")[0] not in path.read_text() and path.read_text().count("quat=") == 1
    found = rj.body.read_inertials(path)["upper"]
    np.testing.assert_allclose(found.inertia.tensor, TENSOR, atol=5e-15)


def test_axes_are_numbered_and_directed_as_in_the_file(tmp_path):
    """A body turned by a hundredth of a radian has moments and axes near those of the file."""
    source = written(tmp_path, MUJOCO)
    old = rj.body.read_inertials(source)["upper"]
    turned = rj.Inertia(1.01 * old.inertia.tensor).rotate(
        rj.quaternion.exp(np.array([3e-3, -5e-3, 4e-3]))
    )
    rj.body.write_inertials(source, {"upper": turned}, source)
    words = source.read_text().split("<inertial ")[1].split("/>")[0]
    moments = [float(x) for x in words.split('diaginertia="')[1].split('"')[0].split()]
    np.testing.assert_allclose(moments, [3.03, 2.525, 1.515], rtol=1e-14)
    q = np.array([float(x) for x in words.split('quat="')[1].split('"')[0].split()])
    np.testing.assert_allclose(q, [0.8, 0.2, -0.4, 0.4], atol=0.011)


def test_an_inertia_leaves_the_mass_and_ratios_leave_the_size(tmp_path):
    path = tidy(tmp_path, "robot.urdf")
    old = rj.body.read_inertials(path)["upper"]
    known = rj.Inertia.from_principal(2.0, 3.0, 4.0)
    rj.body.write_inertials(path, {"upper": known}, path)
    new = rj.body.read_inertials(path)["upper"]
    np.testing.assert_allclose(new.inertia.tensor, known.tensor, atol=3e-15)
    assert (new.mass, *new.com) == (old.mass, *old.com)
    ratios = rj.Inertia(np.diag([0.5, 0.6, 0.9]), "arbitrary")
    with pytest.warns(
        UserWarning, match="only ratios are known: .* stays that of the file, 9 kg m²"
    ):
        rj.body.write_inertials(path, {"upper": ratios}, path)
    new = rj.body.read_inertials(path)["upper"]
    np.testing.assert_allclose(new.inertia.tensor, 4.5 * ratios.tensor, atol=3e-15)


def test_an_inertia_of_no_real_body_is_replaced(tmp_path):
    """A placeholder breaks the triangle inequality; its mass is good enough for an `Inertia`."""
    path = written(tmp_path, URDF.replace('"1.5"', '"9.5"'), "robot.urdf")
    rj.body.write_inertials(path, {"upper": rj.Inertia(TENSOR)}, path)
    np.testing.assert_allclose(rj.body.read_inertials(path)["upper"].inertia.tensor, TENSOR)
    path.write_text(URDF.replace('<mass value="2.0"/>', ""))
    rj.body.write_inertials(path, {"upper": rj.shapes.box(1.0, [1.0, 1, 1])}, path)
    assert rj.body.read_inertials(path)["upper"].mass == 1.0 and 'rpy="0.0 0.0' in path.read_text()


def test_tables_are_found_by_their_numbers(tmp_path):
    """Inner tables, a file that is one body, moments only."""
    path = tmp_path / "one.json"
    path.write_text('{"m": 1, "I": [1, 2, 2.5], "arm": {"left": {"mass": 2, "J": [3, 2, 2]}}}')
    found = rj.body.read_inertials(path)
    assert list(found) == ["body", "arm.left"]
    np.testing.assert_allclose(np.diag(found["body"].inertia.tensor), [1, 2, 2.5])
    rj.body.write_inertials(path, {"arm.left": rj.Inertia.from_principal(4.0, 5.0, 6.0)}, path)
    assert json.loads(path.read_text())["arm"]["left"]["J"] == [4, 5, 6]
    with pytest.raises(ValueError, match="'body': I has three moments: no place for products"):
        rj.body.write_inertials(path, {"body": rj.Inertia(TENSOR)}, path)


def test_a_centre_of_mass_without_a_place_is_told(tmp_path):
    path = tidy(tmp_path, "params.toml")
    body = rj.shapes.box(1.5, [0.1, 0.2, 0.3]).shift([0.0, 0.0, 0.01])
    with pytest.warns(UserWarning, match="'base' has no place for the centre .* 0.0 0.0 0.01 m"):
        rj.body.write_inertials(path, {"base": body}, path)
    read = tomllib.loads(path.read_text())
    np.testing.assert_array_equal(read["base"]["J"], body.inertia.tensor)
    assert read["upper"] == tomllib.loads(TIDY["params.toml"])["upper"]


WRONG = [
    ("model.json", '{"arm": {"mass": 1, "J": [1, 2]}}', "J: wanted finite numbers of shape"),
    ("params.toml", "[arm]\nmass = '1 kg'\nJ = [1, 1, 1]", "mass: wanted finite numbers of shape"),
    ("model.json", '{"arm": {"m": 1, "I": [[1, 1, 0], [0, 1, 0], [0, 0, 1]]}}', "symmetric"),
    ("params.toml", "[arm", "cannot be read as TOML"),
    ("model.json", "{", "cannot be read as JSON"),
]


@pytest.mark.parametrize(("name", "text", "words"), WRONG)
def test_mistakes_in_tables_are_told(tmp_path, name, text, words):
    with pytest.raises(ValueError, match=words):
        rj.body.read_inertials(written(tmp_path, text, name))


def test_a_body_without_an_inertial_needs_a_mass(tmp_path):
    path = written(tmp_path, URDF)
    with pytest.raises(ValueError, match="'base': wanted an <inertial>, got none; its mass"):
        rj.body.write_inertials(path, {"base": rj.Inertia(TENSOR)}, path)
    path = written(tmp_path, "{}", "empty.json")
    with pytest.raises(ValueError, match="no body 'arm'; there are none"):
        rj.body.write_inertials(path, {"arm": rj.Inertia(TENSOR)}, path)


def test_a_text_that_cannot_be_changed_in_place_is_refused(tmp_path):
    path = written(tmp_path, "[arm]\nmass = 0x10\nJ = [1, 1, 1]", "params.toml")
    assert rj.body.read_inertials(path)["arm"].mass == 16.0
    with pytest.raises(ValueError, match="'arm': mass: wanted plain numbers in the text"):
        rj.body.write_inertials(path, {"arm": rj.shapes.box(1.0, [1.0, 1, 1])}, path)
    path = tmp_path / "robot.urdf"
    path.write_bytes(URDF.replace('<?xml version="1.0"?>', "").encode("utf-16"))
    assert list(rj.body.read_inertials(path)) == ["upper"]
    with pytest.raises(ValueError, match="wanted a file in UTF-8"):
        rj.body.write_inertials(path, {"upper": rj.Inertia(TENSOR)}, path)


@pytest.mark.parametrize("turn", ["quat='0 0 0 0'", "axisangle='0 0 0 1'", "zaxis='0 0 0'", "xyaxes='0 0 0 1 0 0'"])  # fmt: skip
def test_an_orientation_of_length_zero_is_refused(turn, tmp_path):
    inertial = f"<inertial mass='1' pos='0 0 0' diaginertia='1 1 1' {turn}/>"
    path = tmp_path / "zero.xml"
    path.write_text(f"<mujoco><worldbody><body name='a'>{inertial}</body></worldbody></mujoco>")
    with pytest.raises(
        ValueError, match=r"body 'a': [a-z]+: wanted a direction, got one of length"
    ):
        rj.body.read_inertials(path)
