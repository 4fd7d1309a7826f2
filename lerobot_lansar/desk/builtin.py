"""The built-in desk: URDFs written from a scene's numbers and the Panda that ships with pybullet_data.

Bodies, links, joints, limits, sizes, masses and friction are CALVIN's; shapes are boxes, prisms, a cylinder and a
sphere; colours are our own. Handles have the sizes of CALVIN's, so a hand that can open the original drawer can open
this one. Lengths are in metres; nothing is scaled on loading.
"""

import itertools
import math
import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import pybullet_data

from .scenes import (
    BLOCK_LENGTHS,
    BLOCK_SIDE,
    BUTTON_TRAVEL,
    BUTTON_Y,
    CABINET_FLOOR,
    DRAWER_TRAVEL,
    SWITCH_TRAVEL,
    Scene,
)

Range = tuple[float, float]
Color = Sequence[float]

BLOCK_COLORS = {"red": (0.92, 0.12, 0.12), "blue": (0.12, 0.20, 0.92), "pink": (0.95, 0.25, 0.85)}
DRAWER_FLOOR = 0.02236
"""Height of the drawer's floor in its own frame (m), CALVIN's."""
WHITE, BLACK, FLOOR = (1.0, 1.0, 1.0), (0.08, 0.08, 0.08), (0.78, 0.80, 0.83)


def write(scene: Scene, folder: Path) -> dict[str, Path]:
    """Writes robot.urdf, desk.urdf, plane.urdf and one URDF per block into `folder`; returns the blocks' files."""
    (folder / "robot.urdf").write_text(_robot())
    (folder / "desk.urdf").write_text(_desk(scene, folder))
    (folder / "plane.urdf").write_text(_plane(folder))
    blocks = {}
    for color, size in scene.blocks.items():
        blocks[color] = folder / f"block_{color}.urdf"
        blocks[color].write_text(_block(color, BLOCK_LENGTHS[size]))
    for file in folder.glob("*.urdf"):
        for name in set(re.findall(r'"(box_\S+)\.obj"', file.read_text())):
            x, y, z = (float(size) / 2 for size in name.split("_")[1:])
            _prism(folder, name, (-x, x), ((-y, -z), (y, -z), (y, z), (-y, z)), WHITE)
    return blocks


# ---- shapes: each returns the <visual> and <collision> elements of one piece of a link


def _shape(geometry: str, color: Color, xyz: Sequence[float] = (0, 0, 0), collides: bool = True) -> str:
    rgba = " ".join(f"{c:.3f}" for c in (*color, 1.0))
    origin = f'<origin xyz="{xyz[0]:.5f} {xyz[1]:.5f} {xyz[2]:.5f}"/>'
    # Bullet's OpenGL renderer lights boxes as if they were round, but not meshes
    drawn = re.sub(r'<box size="(\S+) (\S+) (\S+)"/>', r'<mesh filename="box_\1_\2_\3.obj"/>', geometry)
    visual = (
        f"<visual>{origin}<geometry>{drawn}</geometry>"
        f'<material name="c{rgba}"><color rgba="{rgba}"/></material></visual>'
    )
    return visual + (f"<collision>{origin}<geometry>{geometry}</geometry></collision>" if collides else "")


def _box(x: Range, y: Range, z: Range, color: Color) -> str:
    size = [b - a for a, b in (x, y, z)]
    center = [(a + b) / 2 for a, b in (x, y, z)]
    return _shape(f'<box size="{size[0]:.5f} {size[1]:.5f} {size[2]:.5f}"/>', color, center)


def _prism(folder: Path, name: str, x: Range, profile: Sequence[tuple[float, float]], color: Color) -> str:
    """A convex polygon `profile` of (y, z), counter-clockwise seen from +x, extruded along `x`."""
    n = len(profile)
    lines = [f"v {side:.5f} {y:.5f} {z:.5f}" for side in x for y, z in profile]
    for (y0, z0), (y1, z1) in zip(profile, [*profile[1:], profile[0]], strict=True):
        length = math.hypot(y1 - y0, z1 - z0)
        lines.append(f"vn 0 {(z1 - z0) / length:.5f} {-(y1 - y0) / length:.5f}")
    lines += ["vn -1 0 0", "vn 1 0 0"]
    for i in range(n):
        j = (i + 1) % n
        a, b, c, d = i + 1, j + 1, n + j + 1, n + i + 1
        lines += [f"f {a}//{i + 1} {b}//{i + 1} {d}//{i + 1}", f"f {b}//{i + 1} {c}//{i + 1} {d}//{i + 1}"]
    for i in range(1, n - 1):
        lines.append(f"f 1//{n + 1} {i + 2}//{n + 1} {i + 1}//{n + 1}")
        lines.append(f"f {n + 1}//{n + 2} {n + i + 1}//{n + 2} {n + i + 2}//{n + 2}")
    file = folder / f"{name}.obj"
    file.write_text("\n".join(lines) + "\n")
    return _shape(f'<mesh filename="{file.name}"/>', color)


def _link(name: str, mass: float, shapes: str, contact: str = "") -> str:
    # Bullet computes the inertia from the collision shapes, but requires the tag
    inertial = f'<inertial><mass value="{mass}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    return f'<link name="{name}">{contact}{inertial}{shapes}</link>'


def _joint(
    name: str,
    child: str,
    xyz: Sequence[float],
    *,
    roll: float = 0.0,
    axis: Sequence[float] | None = None,
    travel: float = 0.0,
    parent: str = "base_link",
) -> str:
    kind = "fixed" if axis is None else "prismatic"
    motion = ""
    if axis is not None:
        motion = (
            f'<axis xyz="{axis[0]} {axis[1]} {axis[2]}"/><limit lower="0" upper="{travel}" effort="0" velocity="0"/>'
        )
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{xyz[0]} {xyz[1]} {xyz[2]}" rpy="{roll} 0 0"/>'
        f'<parent link="{parent}"/><child link="{child}"/>{motion}</joint>'
    )


def _robot_document(name: str, *elements: str) -> str:
    return f'<?xml version="1.0"?>\n<robot name="{name}">\n' + "\n".join(elements) + "\n</robot>\n"


# ---- bodies


def _block(color: str, length: float) -> str:
    half, side = length / 2, BLOCK_SIDE / 2
    box = _box((-half, half), (-side, side), (-side, side), BLOCK_COLORS[color])
    contact = '<contact><lateral_friction value="0.7"/><spinning_friction value="0.001"/></contact>'
    return _robot_document(f"block_{color}", _link("base_link", 1.0, box, contact))


def _plane(folder: Path) -> str:
    """A floor of tiles in two shades, one mesh per shade; one big box collides."""
    shapes = []
    for odd, shade in enumerate((0.93, 1.0)):
        lines, faces = ["vn 0 0 1"], []
        for i, j in itertools.product(range(-6, 6), range(-6, 6)):
            if (i + j) % 2 == odd:
                corner = len(lines)
                lines += [f"v {(i + u) / 2} {(j + v) / 2} 0" for u, v in ((0, 0), (1, 0), (1, 1), (0, 1))]
                faces += [f"f {corner}//1 {corner + k}//1 {corner + k + 1}//1" for k in (1, 2)]
        (folder / f"floor_{odd}.obj").write_text("\n".join(lines + faces) + "\n")
        color = [c * shade for c in FLOOR]
        shapes.append(_shape(f'<mesh filename="floor_{odd}.obj"/>', color, collides=False))
    ground = '<collision><origin xyz="0 0 -5"/><geometry><box size="200 200 10"/></geometry></collision>'
    contact = '<contact><lateral_friction value="1"/></contact>'
    return _robot_document("plane", _link("base_link", 0.0, "".join(shapes) + ground, contact))


def _desk(scene: Scene, folder: Path) -> str:
    """CALVIN's desk; its links, and so their indices, in CALVIN's order."""
    tilted, across = math.radians(60), math.radians(150)  # the cabinet's front leans back by 30 degrees
    button, switch, slide = (
        (scene.button_x, BUTTON_Y, 0.46),
        (scene.switch_x, 0.0609, 0.4949),
        (scene.slide_x, 0.075, 0.5353),
    )
    joints = [
        _joint("base__button", "button_link", button, axis=(0, 0, -1), travel=BUTTON_TRAVEL),
        _joint("base__switch", "switch_link", switch, roll=across, axis=(0, 0, -1), travel=SWITCH_TRAVEL),
        _joint("base__slide", "slide_link", slide, roll=tilted, axis=(-1, 0, 0), travel=scene.slide_travel),
        _joint("base__drawer", "drawer_link", (scene.drawer_x, 0.0, 0.32), axis=(0, -1, 0), travel=DRAWER_TRAVEL),
        _joint("base__led", "led_link", (scene.led_x, 0.16, 0.6558)),
        _joint("base__light", "light_link", (scene.light_x, 0.16, 0.6758)),
        _joint("base__plank", "plank_link", (0, 0, 0)),
    ]
    links = [
        _link("base_link", 0.0, _base(scene, folder)),
        _link("button_link", 0.1538, _shape('<cylinder radius="0.031" length="0.022"/>', BLACK, (0, 0, 0.012))),
        _link("switch_link", 0.2388, _switch(scene)),
        _link("slide_link", 1.5435, _slide(scene)),
        _link("drawer_link", 4.2313, _drawer(scene)),
        _link("led_link", 0.204, _shape('<box size="0.158 0.038 0.014"/>', WHITE)),
        _link("light_link", 0.1739, _shape('<sphere radius="0.027"/>', WHITE)),
        _link("plank_link", 2.8438, _box(scene.cabinet, (0.02, 0.16), (0.42, CABINET_FLOOR), scene.dark_wood)),
    ]
    return _robot_document(f"desk_{scene.name}", *links, *joints)


def _base(scene: Scene, folder: Path) -> str:
    wood, dark = scene.wood, scene.dark_wood
    left, right = scene.cabinet
    hole = (scene.drawer_x - 0.20, scene.drawer_x + 0.20)
    wall = [(0.02, 0.44), (0.18, 0.44), (0.18, 0.648), (0.14, 0.648)]
    lid = [(0.128, 0.628), (0.18, 0.628), (0.18, 0.648), (0.14, 0.648)]
    pieces = [
        # the table top: in front of the cabinet, beside it, and lower under the plank that is the cabinet's floor
        _box((-0.44, 0.44), (-0.18, 0.02), (0.40, 0.44), wood),
        _box((-0.44, left), (0.02, 0.18), (0.40, 0.44), wood),
        _box((right, 0.44), (0.02, 0.18), (0.40, 0.44), wood),
        _box((left, right), (0.02, 0.18), (0.40, 0.42), wood),
        # the cabinet
        _prism(folder, "wall_left", (-0.44, left), wall, wood),
        _prism(folder, "wall_right", (right, 0.44), wall, wood),
        _prism(folder, "lid", (left, right), lid, wood),
        _box((left, right), (0.16, 0.18), (0.42, 0.628), dark),
        # the body around the drawer
        _box((-0.42, hole[0]), (-0.16, 0.16), (0.30, 0.40), dark),
        _box((hole[1], 0.42), (-0.16, 0.16), (0.30, 0.40), dark),
        _box(hole, (0.06, 0.16), (0.30, 0.40), dark),
        _box(hole, (-0.16, 0.06), (0.30, 0.32), dark),
    ]
    # a low square rim around the button
    x, y, inner, outer = scene.button_x, BUTTON_Y, 0.032, 0.040
    rim = (0.44, 0.46)
    pieces += [
        _box((x - outer, x + outer), (y - outer, y - inner), rim, dark),
        _box((x - outer, x + outer), (y + inner, y + outer), rim, dark),
        _box((x - outer, x - inner), (y - inner, y + inner), rim, dark),
        _box((x + inner, x + outer), (y - inner, y + inner), rim, dark),
    ]
    legs = [
        _box(across, along, (0.0, 0.40), wood)
        for across in ((-0.44, -0.40), (0.40, 0.44))
        for along in ((-0.18, -0.148), (0.148, 0.18))
    ]
    return "".join(pieces + legs)


def _drawer(scene: Scene) -> str:
    wood, metal = scene.dark_wood, scene.metal
    inside = (0.0, 0.0812)
    return "".join(
        [
            _box((-0.2209, 0.2209), (-0.182, -0.1574), (-0.0209, 0.0812), scene.wood),
            _box((-0.2015, 0.2015), (0.038, 0.0609), inside, wood),
            _box((-0.2015, -0.1769), (-0.1574, 0.038), inside, wood),
            _box((0.1769, 0.2015), (-0.1574, 0.038), inside, wood),
            _box((-0.1769, 0.1769), (-0.1574, 0.038), (0.0, DRAWER_FLOOR), wood),
            _box((-0.1206, -0.0959), (-0.2612, -0.182), (0.0196, 0.0618), metal),
            _box((0.0959, 0.1206), (-0.2612, -0.182), (0.0196, 0.0618), metal),
            _box((-0.0959, 0.0959), (-0.2612, -0.2383), (0.0196, 0.0601), metal),
        ]
    )


def _slide(scene: Scene) -> str:
    # local y runs up the leaning door, local z points out of it
    metal, handle = scene.metal, (0.1192, 0.1608)
    return "".join(
        [
            _box((-0.0006, 0.2806), (-0.1206, 0.1203), (-0.0006, 0.0219), scene.dark_wood),
            _box(handle, (-0.0803, -0.0577), (0.0219, 0.0801), metal),
            _box(handle, (0.0574, 0.0811), (0.0219, 0.0575), metal),
            _box(handle, (-0.0577, 0.0811), (0.0575, 0.0801), metal),
        ]
    )


def _switch(scene: Scene) -> str:
    # local y points out of the cabinet's front: two arms and the bar between them
    depth = (-0.0242, 0.008)
    return "".join(
        [
            _box((-0.0603, 0.0602), (0.0416, 0.0643), depth, scene.metal),
            _box((-0.0603, -0.0396), (0.0, 0.0416), depth, scene.metal),
            _box((0.0386, 0.0602), (0.0, 0.0416), depth, scene.metal),
        ]
    )


def _robot() -> str:
    """pybullet_data's Panda with CALVIN's longer fingers, finger-tip pads, camera mount and TCP.

    The added links come in CALVIN's order, so link and joint indices agree with the original robot. The arm is drawn
    with its collision meshes, which have a tenth of the triangles: drawing takes most of a control step's time.
    """
    meshes = Path(pybullet_data.getDataPath()) / "franka_panda" / "meshes"
    tree = ElementTree.parse(meshes.parent / "panda.urdf")
    root = tree.getroot()
    for link in root.findall("link"):
        finger = link.get("name") in ("panda_leftfinger", "panda_rightfinger")
        for shape in (*link.findall("visual"), *link.findall("collision")):
            mesh = shape.find("geometry/mesh")
            if mesh is None:
                continue
            mesh.set("filename", str(meshes / "collision" / Path(mesh.get("filename", "")).name))
            if finger:
                _lengthen(shape, mesh, 1 if link.get("name") == "panda_leftfinger" else -1)
    extra = [
        '<joint name="camera_joint" type="fixed"><parent link="panda_hand"/><child link="gripper_cam"/>'
        '<origin xyz="-0.1 0 0" rpy="1.3 0 -1.57"/></joint>',
        _link("gripper_cam", 0.2, _shape('<box size="0.08 0.025 0.01"/>', WHITE, collides=False)),
        '<joint name="tcp_joint" type="fixed"><parent link="panda_hand"/><child link="tcp"/>'
        '<origin xyz="0 0 0.14"/></joint>',
        _link("tcp", 1e-5, ""),
    ]
    pad_contact = '<contact><lateral_friction value="1"/><spinning_friction value="0.001"/></contact>'
    for side, sign in (("left", 1), ("right", -1)):
        near, far = sorted((sign * 0.0009, sign * 0.0049))
        pad = _box((-0.0093, 0.0093), (near, far), (0.0707, 0.0957), BLACK)
        extra.append(_joint(f"joint_finger_tip_{side}", f"finger_{side}_tip", (0, 0, 0), parent=f"panda_{side}finger"))
        extra.append(_link(f"finger_{side}_tip", 1e-4, pad, pad_contact))
    for element in extra:
        root.append(ElementTree.fromstring(element))
    return ElementTree.tostring(root, encoding="unicode")


def _lengthen(shape: ElementTree.Element, mesh: ElementTree.Element, side: int) -> None:
    """Stretches pybullet_data's finger (0.054 m long) to the size of CALVIN's (0.096 m), its inner face at 0.0039 m."""
    mesh.set("scale", "1 0.875 1.79")
    origin = shape.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(shape, "origin", rpy="0 0 0")
    origin.set("xyz", f"0 {side * 0.0039} 0")
