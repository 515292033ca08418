"""The simulated SO-100: tasks, scene, environment, scripted experts, and the loop in which an actor moves the arm.

May import MuJoCo and mink, and of the library only its root modules; LeRobot in `lerobot_env` alone. Knows nothing of
data sets or learning. Start reading with `tasks`, then `sim`.
"""
