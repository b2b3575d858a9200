"""Forward kinematics of both arms from their Denavit-Hartenberg tables, batched and differentiable."""

from rmis_calib._lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "JointRow": ".dh",
        "build_chain": ".dh",
        "dh_matrix": ".dh",
        "frame_poses": ".dh",
        "ArmTable": ".arms",
        "HeadPointTable": ".arms",
        "InstrumentPose": ".arms",
        "RobotKinematics": ".arms",
        "RobotTable": ".arms",
    },
)
