"""Files in and out: recordings, robots, cameras, joint logs, video, observations. Units are converted here only."""

from rmis_calib._lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "Arm": ".robot",
        "FrameBatch": ".video",
        "FrameSource": ".video",
        "HeadPoint": ".robot",
        "HeadPoints": ".tables",
        "Joint": ".robot",
        "JointLog": ".joints",
        "Recording": ".recording",
        "RecordingDescription": ".description",
        "Robot": ".robot",
        "ShaftObservations": ".observations",
        "atomic_directory": ".atomic",
        "atomic_write": ".atomic",
        "config_names": ".configs",
        "config_path": ".configs",
        "load_recording": ".recording",
        "load_robot": ".robot",
        "load_yaml": ".configs",
        "open_source": ".video",
        "read_description": ".description",
        "write_json": ".atomic",
        "write_yaml": ".atomic",
    },
)
