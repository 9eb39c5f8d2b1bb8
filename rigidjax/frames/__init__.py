"""Moving frames, and scenes of particles seen from them. No body is needed."""

from typing import TYPE_CHECKING

from rigidjax._names import own_names, suggests
from rigidjax.frames import scenes as scenes
from rigidjax.frames.base import AbstractScene as AbstractScene, Force as Force
from rigidjax.frames.frame_dynamics import (
    BodyInFrame as BodyInFrame,
    InFrame as InFrame,
)
from rigidjax.frames.frame_kinematics import Instant as Instant
from rigidjax.frames.moving import MovingFrame as MovingFrame
from rigidjax.frames.point import Point as Point
from rigidjax.frames.rotation_models import AboutAxis as AboutAxis, Uniform as Uniform

if not TYPE_CHECKING:
    __getattr__ = suggests(__name__)
__dir__ = own_names(__name__)
