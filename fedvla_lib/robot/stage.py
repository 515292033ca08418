"""Environments that are used again, since opening one takes as long as many control steps."""

from functools import cache

from fedvla_lib.robot.sim import So100Env


class Stage:
    """Environments with images of one size; they share one renderer, and those of a task its compiled scene."""

    def __init__(self, image_size: int, jitter: float = 0.0) -> None:
        self._image_size, self._jitter = image_size, jitter
        self._envs: dict[str, list[So100Env]] = {}

    def envs(self, task: str, count: int = 1) -> list[So100Env]:
        """Return `count` environments of a task, in the state in which they were left."""
        drawing = next(iter(self._envs.values()), [None])[0]
        envs = self._envs.setdefault(task, [])
        while len(envs) < count:
            owner = envs[0] if envs else drawing
            envs.append(So100Env(task, self._image_size, jitter=self._jitter, renderer_of=owner))
        return envs[:count]

    def close(self) -> None:
        """Free the renderer and forget the environments; the stage can be used again."""
        for envs in self._envs.values():
            envs[0].close()
        self._envs.clear()


stage_of_process = cache(Stage)  # the one of this process; a worker leaves it open, since it ends with all it opened
