"""The order of the reference: what is asked for first, the modules in groups, topics of long modules.

Names are as the reference writes them. What a module holds beside its topics comes last, under More.
"""

# The table at the head of the reference.
FIRST = {
    "A motion": "rj.simulate rj.solve.Solution",
    "A body": "rj.Inertia rj.MassProperties rj.shapes.box",
    "A state": "rj.Attitude rj.Spin rj.Rigid rj.Turn rj.Point",
    "A torque": "rj.torques.HeavyTop rj.torques.Sum",
    "A rotation": "rj.quaternion.rotate rj.quaternion.exp rj.so3.log",
    "Conserved quantities": "rj.energy rj.conserved rj.drift",
    "The time of an event": "rj.Event rj.crossings",
    "A fit": "rj.identify.fit rj.identify.Model rj.identify.Recording rj.identify.Gyro",
    "Many bodies": "rj.batch.rollout rj.batch.simulate",
    "A picture": "rj.plot.motion rj.plot.polhode rj.plot.fit",
}

GROUPS = {
    "Motion": (
        "rj",
        "rj.motion",
        "rj.torques",
        "rj.solve",
        "rj.solvers",
        "rj.exact",
        "rj.suspensions",
    ),
    "Bodies": ("rj.body", "rj.shapes", "rj.volumes", "rj.parameters"),
    "Rotations": (
        "rj.quaternion",
        "rj.so3",
        "rj.euler",
        "rj.mrp",
        "rj.rodrigues",
    ),
    "Identification": (
        "rj.identify",
        "rj.identify.report",
        "rj.datasets",
        "rj.datasets.toutatis",
        "rj.datasets.moon",
    ),
    "Many bodies": ("rj.batch", "rj.batch.distributed"),
    "Frames and space": (
        "rj.frames",
        "rj.scenes",
        "rj.orbits",
        "rj.tumblers",
        "rj.tumblers.brightness",
        "rj.tumblers.plot",
    ),
    "Pictures, special functions, measurements": (
        "rj.plot",
        "rj.elliptic",
        "rj.lagrangian",
        "rj.workprecision",
    ),
}

TOPICS = {
    "rj.motion": {
        "States": "Spin Attitude Rigid Turn",
        "What a state has": "HasSpin HasAttitude HasPose",
        "Bound to an axis": "AbstractSuspension",
    },
    "rj.torques": {
        "Gravity and fields": "HeavyTop GravityGradient MagneticDipole FromPotential Tide",
        "Given torques": "ConstantTorque InSpace Tabulated Pulses",
        "Air": "Damping QuadraticDamping Drag BodyDrag",
        "Wheels and propellers": "Flywheel Wheel ReactionWheels Rotors",
        "Forces": "UniformGravity CentralGravity Wrench",
        "A given motion": "Carried LoggedMotion Kinematics",
        "Functions of time, measured inputs": "Linear Series Chebyshev Held Input bind Delayed Lagged",
        "Unknown torques": "RandomTorque CorrelatedTorque",
        "Laws together, laws of your own": "Sum AbstractTorque ChangingInertia",
    },
    "rj.solve": {
        "A run": "simulate Solution",
        "Events, sections, exponents": "Event crossings lyapunov_exponents",
        "The loops and the equations": "equations_of_motion adaptive fixed",
    },
    "rj.body": {
        "Bodies": "Inertia MassProperties read_inertials write_inertials",
        "Energy and momentum": "kinetic_energy kinetic_energy_about "
        "kinetic_energy_of_matrix_rate angular_momentum spatial_angular_momentum",
        "Principal axes and ellipsoids": "principal matrix_function ellipsoid",
        "Distance of two bodies, random bodies": "divergence sample Draw",
    },
    "rj.identify": {
        "The model": "Model Recording Scene Free",
        "What is fitted of the body": "PrincipalRatios Ratios Principal Tensor Mass Known "
        "AbstractBodyChart",
        "Sensors": "Gyro Accelerometer AttitudeSensor Direction Magnetometer Marker Position "
        "Velocity Range AbstractSensor SensorInput",
        "The fit and its result": "fit Fit Unpacked",
        "How it searches": "SoftL1 Huber AbstractLoss FixedSteps Adaptive Descent descend Entropic "
        "Measured",
        "Uncertainty, comparison": "compare",
        "Before the experiment": "simulate_readings expected_quantities fisher",
        "Short windows of driven bodies": "windows Windows predict_windows",
        "Unknown torques: filter and smoother": "Walk first_belief filter smooth step",
        "Likelihood, simulated motions": "log_likelihood sample",
        "Posterior": "LogDensity refit Refit posterior Posterior Nuts",
        "Log files": "read_table find_phases Phase",
    },
}
