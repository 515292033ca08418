"""Off-screen rendering, safe with several environments in one process, and projection into a camera's image."""

import atexit
import gc
import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import numpy as np

PIXEL = "V3"  # NumPy's type of three bytes, much faster to copy than three numbers
BACKGROUNDS = 16  # kept by a renderer: those of two cameras in eight labs


class SceneRenderer(mujoco.Renderer):
    """A renderer of fixed cameras that can be closed without breaking the other renderers of the process.

    Table, base and sky are drawn once, with their depth; what moves is drawn for each image and put in front of them.
    The pixels are those of drawing all at once, as long as nothing is transparent.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        try:
            super().__init__(model, height, width, max_geom=model.ngeom + model.nsite)  # MuJoCo's 10,000 take 15 ms
        except (mujoco.FatalError, RuntimeError, AttributeError) as error:  # which one depends on the driver
            raise RuntimeError(
                f"cannot render off screen with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r} ({error}): set MUJOCO_GL "
                "to egl, osmesa or glfw before mujoco is first imported, or import fedvla_lib.robot.sim before it"
            ) from error
        self._view, self._options = mujoco.MjvCamera(), mujoco.MjvOption()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._fixed = np.flatnonzero(model.body_weldid[model.geom_bodyid] == 0)  # geoms
        self._backgrounds: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
        # At exit MuJoCo closes its OpenGL display before Python destroys the renderers that still use it.
        atexit.register(_close, weakref.ref(self))

    def draw(self, model: mujoco.MjModel, data: mujoco.MjData, camera: str) -> np.ndarray:
        """Return the image, uint8 (height, width, 3); `model` must have the meshes of the model given at creation."""
        self._view.fixedcamid = model.camera(camera).id
        with garbage_collection_paused():
            self._gl_context.make_current()
            image, nearness = self._layer(model, data, mujoco.mjtCatBit.mjCAT_DYNAMIC)
            behind, behind_nearness = self._background(model, data)
        hidden = behind_nearness > nearness
        np.copyto(image.view(PIXEL), behind.view(PIXEL), where=hidden[..., None])
        return image[::-1].copy()  # OpenGL's first row is the lowest

    def _background(self, model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Return the layer of what is fixed to the world, redrawn if camera, light, a place or a colour changed."""
        shown = (
            data.cam_xpos, data.cam_xmat, model.cam_fovy, data.light_xpos, data.light_xdir, model.light_diffuse,
            model.vis.headlight.ambient, model.vis.headlight.diffuse, model.mat_rgba, model.geom_rgba[self._fixed],
            data.geom_xpos[self._fixed], data.geom_xmat[self._fixed],
        )  # fmt: skip
        key = b"".join([bytes([self._view.fixedcamid]), *(values.tobytes() for values in shown)])
        if key not in self._backgrounds:
            if len(self._backgrounds) == BACKGROUNDS:
                del self._backgrounds[next(iter(self._backgrounds))]  # the oldest
            self._backgrounds[key] = self._layer(model, data, mujoco.mjtCatBit.mjCAT_STATIC)
        return self._backgrounds[key]

    def _layer(self, model: mujoco.MjModel, data: mujoco.MjData, category: int) -> tuple[np.ndarray, np.ndarray]:
        """Draw what is fixed to the world (mjCAT_STATIC), with the sky, or what is not (mjCAT_DYNAMIC).

        Returns:
            From the lowest row up: the colours, uint8 (height, width, 3), and float32 (height, width) that is
            larger for nearer points, and 0 where nothing is.
        """
        self.scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = category == mujoco.mjtCatBit.mjCAT_STATIC
        mujoco.mjv_updateScene(model, data, self._options, None, self._view, category, self.scene)
        image, nearness = np.empty((self.height, self.width, 3), np.uint8), np.empty((self.height, self.width), "f4")
        mujoco.mjr_render(self._rect, self.scene, self._mjr_context)
        mujoco.mjr_readPixels(image, nearness, self._rect, self._mjr_context)
        return image, nearness

    def close(self) -> None:
        """Free the buffers in this renderer's own OpenGL context; MuJoCo frees them in whichever one is current.

        Buffer ids are per context: freeing them in another's frees that renderer's buffers, and it returns garbage.
        """
        if self._gl_context:
            self._gl_context.make_current()
        super().close()


def pose_between(
    model: mujoco.MjModel, data: mujoco.MjData, before: np.ndarray, after: np.ndarray, share: float
) -> None:
    """Pose a scene a share of the way from one `qpos` to another; orientations turn at a constant rate."""
    way = np.empty(model.nv)
    mujoco.mj_differentiatePos(model, way, 1.0, before, after)
    data.qpos[:] = before
    mujoco.mj_integratePos(model, data.qpos, way, share)
    mujoco.mj_forward(model, data)


@contextmanager
def garbage_collection_paused() -> Iterator[None]:
    """Pause garbage collection: collecting another renderer would change the current OpenGL context while rendering."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _close(reference: "weakref.ref[SceneRenderer]") -> None:
    renderer = reference()
    if renderer is not None:
        renderer.close()


def project(model: mujoco.MjModel, data: mujoco.MjData, camera: str, points_m: np.ndarray) -> np.ndarray:
    """Project points of the world frame, float64 (n, 3), into a camera's image.

    Returns:
        float64 (n, 2): distance from the left and from the top edge, as fractions of the side of the square image;
        outside [0, 1] if not in view. Pinhole camera: fraction = 1/2 + x / (2 z tan(fov / 2)).
    """
    view, angle_rad = data.camera(camera), np.deg2rad(model.camera(camera).fovy[0])
    right, up, back = ((points_m - view.xpos) @ view.xmat.reshape(3, 3)).T  # the camera looks along minus its z axis
    scale = 1 / (2 * np.tan(angle_rad / 2))
    return np.column_stack([0.5 - scale * right / back, 0.5 + scale * up / back])
