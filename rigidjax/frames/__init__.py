"""Who watches: moving frames, and scenes of particles seen from them. No body is needed."""

from rigidjax._names import own_names
from rigidjax.frames import scenes as scenes
from rigidjax.frames.inside import (
    BodyInFrame as BodyInFrame,
    InFrame as InFrame,
    scene_of as scene_of,
)
from rigidjax.frames.instant import Instant as Instant
from rigidjax.frames.moving import MovingFrame as MovingFrame
from rigidjax.frames.point import Point as Point
from rigidjax.frames.scene import AbstractScene as AbstractScene, Force as Force
from rigidjax.frames.turning import AboutAxis as AboutAxis, Uniform as Uniform

__dir__ = own_names(__name__)
