"""Inertials from and to URDF and MuJoCo's XML: frames, round trips, what no body has."""

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
        "body 'upper': its inertial is turned by euler; wanted quat",
    ),
    ("<world/>", "wanted a URDF .robot. or MuJoCo file, got <world>"),
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
