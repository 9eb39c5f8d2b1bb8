"""Describe moving frames, and particles that move in such frames. No rigid body is needed."""

from rigidjax._names import define_dir_and_getattr
from rigidjax.frames.base import AbstractScene as AbstractScene, Force as Force
from rigidjax.frames.frame_dynamics import BodyInFrame as BodyInFrame
from rigidjax.frames.moving import MovingFrame as MovingFrame
from rigidjax.frames.point import Point as Point
from rigidjax.frames.rotation_models import AboutAxis as AboutAxis, Uniform as Uniform

__all__ = ["AboutAxis", "AbstractScene", "BodyInFrame", "Force", "MovingFrame", "Point", "Uniform"]

define_dir_and_getattr(__name__)
