"""The simulated SO-100: tasks, scene, environment, scripted experts and the control loop.

May import MuJoCo, mink and the library's root modules; only `lerobot_env` imports LeRobot. Does not know data sets or
learning. Start reading with `tasks`, then `sim`.
"""
