"""Federated learning of robot policies, small enough to read: the library behind the book."""

import os
import sys
import warnings

# MuJoCo reads the variable when it is first imported, and its own default needs a display.
if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("LP_NUM_THREADS", "0")  # Mesa's software renderer: its threads cost more than they do
# tqdm asks every notebook reader to install widgets; its plain text bar is what this book shows.
warnings.filterwarnings("ignore", message="IProgress not found")
