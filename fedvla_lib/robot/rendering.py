"""Off-screen rendering, safe with several environments in one process, and projection into a camera's image."""

import atexit
import gc
import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import numpy as np


class SceneRenderer(mujoco.Renderer):
    """A renderer of fixed cameras that can be closed without breaking the other renderers of the process."""

    def __init__(self, model: mujoco.MjModel, height: int, width: int) -> None:
        super().__init__(model, height, width)
        self._view, self._options = mujoco.MjvCamera(), mujoco.MjvOption()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        # At exit MuJoCo closes its OpenGL display before Python destroys the renderers that still use it.
        atexit.register(_close, weakref.ref(self))

    def draw(self, model: mujoco.MjModel, data: mujoco.MjData, camera: str) -> np.ndarray:
        """Return the image, uint8 (height, width, 3); `model` must have the meshes of the model given at creation."""
        self._view.fixedcamid = model.camera(camera).id
        categories = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._options, None, self._view, categories, self.scene)
        with garbage_collection_paused():
            return self.render()

    def close(self) -> None:
        """Free the buffers in this renderer's own OpenGL context; MuJoCo frees them in whichever one is current.

        Buffer ids are per context: freeing in another's deletes that renderer's buffers, and it returns garbage then.
        """
        if self._gl_context:
            self._gl_context.make_current()
        super().close()


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


def open_renderer(model: mujoco.MjModel, image_size: int) -> SceneRenderer:
    try:
        return SceneRenderer(model, image_size, image_size)
    except (mujoco.FatalError, RuntimeError, AttributeError) as error:  # which one depends on the driver
        raise RuntimeError(
            f"cannot render off screen with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r} ({error}): set MUJOCO_GL to "
            "egl, osmesa or glfw before mujoco is first imported, or import fedvla_lib.robot.sim before it"
        ) from error


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
