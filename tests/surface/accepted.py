"""What the fuzz finds and is right, or is known and not mended here: each with its reason."""

import fnmatch

OVERFLOW = (
    "products of two to four numbers leave the dtype beyond 1e75, the range that rotation.algebra "
    "states; what is large or small below that is tried as well, and must be right"
)
NO_PHASE = "x holds the initial rate: after seconds at 1e75 rad/s no digit of the phase is left"
REACHED = "a body's status says what happened to it, and its states are NaN: documented"
ANY_TREE = "a tree of whatever NumPy makes an array of"
BY_NUMBER = (
    "a function of arrays, number by number, as SciPy's of the same names: outside of its domain, "
    "which its docstring states, it gives NaN there and the right numbers beside"
)
NO_NUMBERS = "a function of arrays, number by number: of no numbers it makes none"
OF_TIME = "a function of time is documented; its value is looked at where it is used"
CRAMER = (
    "a well conditioned matrix is documented; it stands in the middle of vector fields, where the "
    "quotient by a determinant of zero is told by what follows"
)
NOT_MEASURED = "NaN stands in a record for what was not measured: documented"
NOTHING = "of no records there is nothing to say: an empty table"
LIMIT = "the right limit for an infinite argument"

# (row, argument: replacement, what came of it, reason), as patterns; the first that fits counts.
ACCEPTED: list[tuple[str, str, str, str]] = [
    (
        "motion.torques.LoggedMotion.from_poses",
        "*: float32",
        "returned*",
        "a second derivative of smoothed poses has two digits fewer than the poses",
    ),
    # Light: directions of time, no period to fold with, no motion to draw.
    *(
        ("tumblers.Brightness", f"{name}: function", "taken without a word*", OF_TIME)
        for name in ("sun", "observer")
    ),
    (
        "tumblers.plot.light_curve",
        "periods: empty list",
        "*",
        "no period is documented: nothing is folded",
    ),
    ("tumblers.plot.light_curve", "model: None", "*", "None is documented: no motion is drawn"),
    *(
        (
            name,
            "f*: float16",
            "names none of*",
            "the words name the first number in the fit that is of half precision",
        )
        for name in ("identify.report.*", "plot.fit", "plot.residuals")
    ),
    # Estimates.
    *(
        (f"identify.{name}", "good call", "returned*", "lost_at is NaN where nothing was lost")
        for name in ("filter", "smooth")
    ),
    # Polynomials of states and bodies.
    ("body.divergence", "*: huge", "a silent NaN*", OVERFLOW),
    ("body.kinetic_energy*", "*: huge", "a silent NaN*", OVERFLOW),
    ("conserved", "state: huge", "a silent NaN*", OVERFLOW),
    ("energy", "state: huge", "a silent NaN*", OVERFLOW),
    ("drift", "*: huge", "a silent NaN*", OVERFLOW),
    ("equations_of_motion", "body: huge", "a silent NaN*", OVERFLOW),
    ("lagrangian.*Hamiltonian", "inertia: huge", "a silent NaN*", OVERFLOW),
    ("motion.torques.*", "state: huge", "a silent NaN*", OVERFLOW),
    ("frames.scenes.*", "state: huge", "a silent NaN*", OVERFLOW),
    ("orbits.ThreeBody.*", "*: huge", "a silent NaN*", OVERFLOW),
    ("orbits.Hill.jacobi_constant", "state: huge", "a silent NaN*", OVERFLOW),
    ("rotation.mrp.*", "sigma: huge", "a silent NaN*", OVERFLOW),
    ("rotation.quaternion.rotate*", "q: huge", "a silent NaN*", OVERFLOW),
    ("rotation.quaternion.to_matrix", "q: huge", "a silent NaN*", OVERFLOW),
    ("rotation.so3.conjugate", "matrix: huge", "a silent NaN*", OVERFLOW),
    *(
        ("rotation.so3.solve", f"a: {size}", "a silent NaN*", OVERFLOW)
        for size in ("huge", "tiny", "subnormal")
    ),
    ("rotation.so3.solve", "a: zero", "a silent NaN*", CRAMER),
    ("rotation.so3.determinant", "a: huge", "a silent NaN*", OVERFLOW),
    ("body.parameters.unpack_*", "vector: huge", "a silent NaN*", OVERFLOW),
    ("body.parameters.curvature_rows_near_flat_body", "shape: huge", "a silent NaN*", OVERFLOW),
    ("identify.Model.unpack", "x: huge", "a silent NaN*", OVERFLOW),
    ("identify.Model.errors", "x: huge", "a silent NaN*", NO_PHASE),
    ("identify.Model.errors", "x: large", "a silent NaN*", NO_PHASE),
    ("identify.Model.motion", "x: huge", "a silent NaN*", NO_PHASE),
    ("identify.Model.motion", "x: large", "a silent NaN*", NO_PHASE),
    # Domains.
    (
        "body.matrix_function",
        "tensor: *",
        "a silent NaN*",
        "the square root is not smooth at 0, has no real value below, and its second derivative "
        "overflows below 1e-205: the function must be smooth on the spectrum",
    ),
    ("elliptic.r*", "*: negative", "a silent NaN*", BY_NUMBER),
    ("elliptic.ellip* (no complement)", "[mn]: huge", "a silent NaN*", BY_NUMBER),
    ("elliptic.ellip* (no complement)", "[mn]: large", "a silent NaN*", BY_NUMBER),
    ("elliptic.ellipk (no complement)", "m: all -inf", "infinity is lost*", LIMIT),
    ("elliptic.*", "*: empty list", "taken without a word*(0,)*", NO_NUMBERS),
    ("body.parameters.unpack_moments", "vector: all -inf", "infinity is lost*", LIMIT),
    ("orbits.ThreeBody.potential", "x: inf", "infinity is lost*", LIMIT),
    ("orbits.ThreeBody.speed_squared", "x: inf", "infinity is lost*", LIMIT),
    # Batches.
    ("batch.rollout", "*", "a silent NaN*", REACHED),
    ("batch.simulate*", "*", "a silent NaN*", REACHED),
    ("batch.distributed.*", "tree: *", "taken without a word*", ANY_TREE),
    # Others.
    *(
        (f"workprecision.{name}", *what, NOT_MEASURED)
        for name in ("choose",)
        for what in (("good call", "returned*"), ("*", "a silent NaN*"))
    ),
    *(
        (f"workprecision.{name}", f"*: {empty}", "taken without a word*", NOTHING)
        for name in ("choose", "table")
        for empty in ("dict", "empty list")
    ),
    ("identify.Recording", "inputs: dict", "taken*", "no input at all is documented: none is read"),
    ("identify.find_phases", "motors: empty list", "taken*", "none is documented: no motor runs"),
    ("identify.windows", "inputs: dict", "taken*", "no input at all is documented: none is read"),
    *(
        (f"motion.torques.{law}", "*: function", "taken without a word*", OF_TIME)
        for law in (
            "Flywheel",
            "GravityGradient",
            "InSpace",
            "Rotors",
            "MagneticDipole",
            "ReactionWheels",
            "Tide",
        )
    ),
    ("drift", "*: float32", "returned*", "drift is round-off itself, so that it has no digits"),
    ("frames.Force", "force: None", "taken*", "None is documented: the particle is left to itself"),
    ("identify.Recording", "mask: None", "taken*", "None is documented: nothing is masked"),
    ("identify.Recording", "inputs: None", "taken*", "None is documented: no inputs at all"),
    ("simulate (options)", "max_steps: None", "taken*", "None is documented: as many as it takes"),
]


def reason(name: str, where: str, what: str) -> str | None:
    """Why this is accepted; `None` if it is not."""
    for row, place, came, why in ACCEPTED:
        if all(fnmatch.fnmatchcase(*pair) for pair in ((name, row), (where, place), (what, came))):
            return why
    return None
