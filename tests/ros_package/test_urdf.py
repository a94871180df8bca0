"""The URDF macro: the published frames and body of every model, and a tree that URDF readers take."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest
import xacro
import yaml

from ethercat_server.sensor.models import MODELS
from tests.ros_package.package_files import PACKAGE

URDF = PACKAGE / "urdf"
# From the mounting face to the wrench's origin and to the IMU, in mm.
FIGURES = {
    "SENS": (35.0, 9.3),
    "ROKS": (32.0, 9.8),
    "ROKA": (32.0, 9.8),
    "MEDS": (32.0, 9.8),
    "MEDA": (32.0, 9.8),
    "LAXS": (44.5, 11.95),
    "MEGS": (59.0, 13.4),
}


def example_text(**arguments: str) -> str:
    return str(
        xacro.process_file(str(URDF / "example.urdf.xacro"), mappings=arguments).toprettyxml(indent="  ")
    )


def example(**arguments: str) -> ElementTree.Element:
    return ElementTree.fromstring(example_text(**arguments))


def offset_mm(robot: ElementTree.Element, parent: str, child: str) -> float:
    """How far along z the fixed joint between two links reaches; nothing else may be moved or turned."""
    joints = robot.findall(f"joint/child[@link='{child}']/..")
    (joint,) = [joint for joint in joints if joint.find(f"parent[@link='{parent}']") is not None]
    assert joint.get("type") == "fixed"
    origin = joint.find("origin")
    assert origin is not None
    assert origin.get("rpy") == "0 0 0"
    x, y, z = (float(text) for text in str(origin.get("xyz")).split())
    assert (x, y) == (0.0, 0.0)
    return z * 1000


def numbers(element: ElementTree.Element | None, *names: str) -> list[float]:
    assert element is not None
    return [float(number) for name in names for number in str(element.get(name)).split()]


def test_unknown_models_and_bodies(capsys: pytest.CaptureFixture[str]) -> None:
    assert not example(model="MEGS").findall("link/*")
    with pytest.raises(xacro.XacroException, match="no model FOO: it must be one of SENS, ROKS"):
        example(model="FOO")


def test_a_parameter_of_ros_which_is_yaml_takes_it_as_text() -> None:
    """`-p robot_description:="$(xacro FILE)"`: a comment with a colon would be a mapping, and an error."""
    text = example_text()
    assert "<!--" in text
    assert ElementTree.fromstring(yaml.safe_load(text)).tag == "robot"


@pytest.mark.parametrize("name", MODELS)
def test_frames_of_every_model_that_the_server_knows_are_where_the_figures_say(name: str) -> None:
    robot = example(model=name)
    wrench, imu = FIGURES[name.split("-")[1]]
    assert offset_mm(robot, "ft_sensor_mounting", "ft_sensor") == pytest.approx(wrench)
    assert offset_mm(robot, "ft_sensor_mounting", "ft_sensor_imu") == pytest.approx(imu)


def test_two_sensors_fit_on_one_robot() -> None:
    text = f"""<robot name="two" xmlns:xacro="http://www.ros.org/wiki/xacro">
      <xacro:include filename="{URDF / "bota_sensor.xacro"}"/>
      <link name="base"/>
      <xacro:bota_sensor model="SENS" parent="base" prefix="a_"><origin xyz="0 0 1"/></xacro:bota_sensor>
      <xacro:bota_sensor model="MEGS" parent="a_ft_sensor" prefix="b_" mass="1.5" diameter="0.12">
        <origin/>
      </xacro:bota_sensor>
    </robot>"""
    document = xacro.parse(text)
    xacro.process_doc(document)
    robot = ElementTree.fromstring(document.toxml())
    links = [str(link.get("name")) for link in robot.findall("link")]
    names = ("ft_sensor_mounting", "ft_sensor", "ft_sensor_imu")
    assert links == ["base", *(side + name for side in ("a_", "b_") for name in names)]
    assert len({joint.get("name") for joint in robot.findall("joint")}) == len(links) - 1
    assert sorted(str(child.get("link")) for child in robot.findall("joint/child")) == sorted(links[1:])
    assert offset_mm(robot, "a_ft_sensor_mounting", "a_ft_sensor") == pytest.approx(35)
    assert offset_mm(robot, "b_ft_sensor_mounting", "b_ft_sensor") == pytest.approx(59)
    assert [numbers(mass, "value") for mass in robot.findall("link/inertial/mass")] == [[0.239], [1.5]]
    radii = [numbers(cylinder, "radius") for cylinder in robot.findall("link/collision/geometry/cylinder")]
    assert radii == [[0.035], [0.06]]
