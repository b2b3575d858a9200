"""A scene served to browsers by viser (https://viser.studio): one page, motions on a slider.

viser's world has z up and no unit; here it is `base` of the robot, in millimetres.
"""

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from rmis_calib.errors import InputError
from rmis_calib.geometry.rigid import rigid_inverse, transform_points
from rmis_calib.geometry.rotations import matrix_to_quat
from rmis_calib.io import Recording, load_recording
from rmis_calib.pipeline.answer.predicted_shaft import in_picture, shaft_edges
from rmis_calib.pipeline.scene import PlacedCameras, Scene, advised_scene, place_cameras, scene_of
from rmis_calib.results import CalibrationResult
from rmis_calib.vision import draw_polyline

LAPAROSCOPE, INSTRUMENT, SHAFT, GHOST = (90, 110, 140), (150, 120, 90), (40, 40, 44), (60, 160, 90)
RESULT_COLOURS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0))
"""Told apart by the colour-blind (Okabe & Ito 2008)."""
FRUSTUM_MM = 20.0
SIGMAS = 3.0
"""Half axes of the ellipsoid, in sigmas."""
PLAY_HZ = 10.0
_BACK = 1.6
"""Distance of the first view, in sizes of what it shows: the controls cover a quarter of a window."""


@dataclass(frozen=True)
class _Shown:
    """One result in the scene."""

    scene: Scene
    cameras: PlacedCameras
    colour: tuple[int, int, int]


class Viewer:
    """A running page.

    Attributes:
        url: where to open it.
    """

    def __init__(
        self, recording: Recording, results: Mapping[str, CalibrationResult], host: str = "127.0.0.1", port: int = 8080
    ) -> None:
        """Serve a recording with results of it; use `open_viewer` from files.

        Args:
            recording: an opened recording.
            results: by the name to show; those without a transform are left out.
            host: address to bind: by default only this machine can look.
            port: to listen on; the next free one where it is taken.

        Raises:
            InputError: viser is not installed.
        """
        try:
            import viser
        except ImportError as error:
            raise InputError(
                where="view", expected="viser (pip install 'rmis-calib[view]')", found=f"no such package: {error.name}"
            ) from error
        self._recording, self._results = recording, results
        self._arms = scene_of(recording, next(iter(results.values()), None))
        self._shown = {}
        for colour, (name, result) in zip(cycle(RESULT_COLOURS), results.items(), strict=False):
            if result.camera_right_T_arm is not None:
                scene = scene_of(recording, result)
                self._shown[name] = _Shown(scene, place_cameras(scene, recording, result), colour)
        self._ghosts = {name: advised_scene(recording, result) for name, result in results.items()}
        self._server = viser.ViserServer(host=host, port=port, label="rmis_calib", verbose=False)
        self._server.scene.set_up_direction("+z")
        self.url = f"http://{host}:{self._server.get_port()}"
        self._motion, self._playing = 0, threading.Event()
        self._lock = threading.Lock()
        self._controls(results)
        self._draw_fixed()
        self.show(0)
        self._look_at_work()

    @property
    def motions(self) -> int:
        """Number of motions to step through."""
        return len(self._arms.frames)

    @property
    def watchers(self) -> int:
        """Number of browsers that look on."""
        return len(self._server.get_clients())

    def show(self, motion: int) -> None:
        """Put the scene at one motion."""
        with self._lock, self._server.atomic():
            self._motion = min(max(motion, 0), self.motions - 1)
            self._slider.value = self._motion
            self._draw_arms(self._arms, self._motion)
            picture = self._picture(self._motion)
            for name, shown in self._shown.items():
                at = min(self._motion, len(shown.scene.frames) - 1)
                self._draw_cameras(name, shown, at, picture)
            self._image.image = self._overlay(picture, self._motion)
            frame, time_s = int(self._arms.frames[self._motion]), float(self._arms.times_s[self._motion])
            self._where.content = f"frame {frame}, {time_s:.2f} s"

    def wait(self) -> None:
        """Block until interrupted, playing where that is asked for."""
        while True:
            self._playing.wait()
            self.show((self._motion + 1) % self.motions)
            threading.Event().wait(1.0 / PLAY_HZ)

    def close(self) -> None:
        """Stop serving."""
        self._server.stop()

    def _controls(self, results: Mapping[str, CalibrationResult]) -> None:
        gui = self._server.gui
        self._slider = gui.add_slider("motion", 0, max(1, self.motions - 1), 1, 0)
        self._where = gui.add_markdown("")
        play = gui.add_checkbox("play", False)
        ghost = gui.add_checkbox("next advised motion", True)
        self._image = gui.add_image(self._picture(0), label="camera_right")
        for colour, (name, result) in zip(cycle(RESULT_COLOURS), results.items(), strict=False):
            hexed = "#{:02x}{:02x}{:02x}".format(*colour)
            gui.add_markdown(f"<span style='color:{hexed}'>■</span> **{name}**: {result.message}")
        gui.add_markdown(
            f"Ellipsoids: {SIGMAS:.0f} sigma of the point where the instrument works. Millimetres, in `base`."
        )
        self._slider.on_update(lambda _: self._moved())
        play.on_update(lambda _: self._playing.set() if play.value else self._playing.clear())
        ghost.on_update(lambda _: self._draw_ghosts(ghost.value))

    def _moved(self) -> None:
        if self._slider.value != self._motion:  # moved by a person, and not by `show`
            self.show(int(self._slider.value))

    def _draw_fixed(self) -> None:
        scene = self._server.scene
        scene.add_frame("/base", axes_length=40.0, axes_radius=1.0)
        scene.add_label("/base/name", "base")
        self._draw_ghosts(True)

    def _draw_ghosts(self, visible: bool) -> None:
        for number, ghost in enumerate(self._ghosts.values()):
            if ghost is not None:
                self._cylinder(f"/advised {number}", ghost.rcm[0], ghost.end[0], ghost.radius_mm, GHOST, 0.4, visible)

    def _draw_arms(self, arms: Scene, motion: int) -> None:
        if arms.laparoscope_points is not None:
            self._chain("/laparoscope", arms.laparoscope_points[motion], LAPAROSCOPE)
        self._chain("/instrument", arms.instrument_points[motion], INSTRUMENT)
        self._cylinder("/shaft", arms.rcm[motion], arms.end[motion], arms.radius_mm, SHAFT)
        for name, point, colour in (("rcm", arms.rcm, (220, 50, 47)), ("head point", arms.head, (240, 200, 60))):
            self._server.scene.add_icosphere(f"/{name}", 2.5, colour, position=point[motion])
            self._server.scene.add_label(f"/{name}/name", name)

    def _draw_cameras(self, name: str, shown: _Shown, motion: int, picture: np.ndarray) -> None:
        scene, cameras = self._server.scene, shown.cameras
        for side, base_T_camera in cameras.base_T_camera.items():
            pose = base_T_camera[motion]
            scene.add_camera_frustum(
                f"/{name}/camera_{side}",
                fov=cameras.fov_rad[side],
                aspect=cameras.aspect[side],
                scale=FRUSTUM_MM,
                thickness=1.5,
                thickness_units="screen",
                color=shown.colour,
                image=picture if side == "right" else None,
                wxyz=_quaternion(pose[:3, :3]),
                position=pose[:3, 3],
            )
        if cameras.working_point is not None and cameras.working_covariance is not None:
            values, axes = np.linalg.eigh(cameras.working_covariance[motion])
            axes = axes * np.sign(np.linalg.det(axes))
            scene.add_icosphere(
                f"/{name}/uncertainty",
                1.0,
                shown.colour,
                scale=tuple(SIGMAS * np.sqrt(values.clip(1e-6))),
                opacity=0.45,
                wxyz=_quaternion(axes),
                position=cameras.working_point[motion],
            )

    def _chain(self, name: str, points: Float[np.ndarray, "f 3"], colour: tuple[int, int, int]) -> None:
        segments = np.stack((points[:-1], points[1:]), axis=1)
        lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=-1)
        self._server.scene.add_line_segments(
            f"{name}/links", segments[lengths > 1e-6], colour, thickness=4.0, thickness_units="screen"
        )
        for index, point in enumerate(points):
            self._server.scene.add_icosphere(f"{name}/joint {index}", 2.0, colour, position=point, subdivisions=2)

    def _cylinder(
        self,
        name: str,
        start: Float[np.ndarray, "3"],
        end: Float[np.ndarray, "3"],
        radius_mm: float,
        colour: tuple[int, int, int],
        opacity: float | None = None,
        visible: bool = True,
    ) -> None:
        along = end - start
        length = float(np.linalg.norm(along))
        self._server.scene.add_cylinder(
            name,
            radius_mm,
            length,
            colour,
            opacity=opacity,
            wxyz=_turning_z_to(along / max(length, 1e-9)),
            position=0.5 * (start + end),
            visible=visible,
        )

    def _picture(self, motion: int) -> np.ndarray:
        image = self._recording.right.frame(int(self._arms.frames[motion])).permute(1, 2, 0).numpy()
        return np.ascontiguousarray(image[:: max(1, image.shape[1] // 480), :: max(1, image.shape[1] // 480)])

    def _overlay(self, picture: np.ndarray, motion: int) -> np.ndarray:
        """The picture with the shaft's edges where each result predicts them, in its colour."""
        canvas = picture.copy()
        step = self._recording.stereo.right.image_size[1] // picture.shape[1]
        for name, shown in self._shown.items():
            at = min(motion, len(shown.scene.frames) - 1)
            camera_T_base = rigid_inverse(torch.as_tensor(shown.cameras.base_T_camera["right"][at]))
            rcm = transform_points(camera_T_base, torch.as_tensor(shown.scene.rcm[at]))
            camera = self._recording.stereo.right.corrected(*self._results[name].intrinsic_correction("right"))
            end = transform_points(camera_T_base, torch.as_tensor(shown.scene.end[at]))
            for edge in in_picture(camera, shaft_edges(rcm, end, shown.scene.radius_mm)):
                draw_polyline(canvas, edge / step, shown.colour, 2)
        return canvas

    def _look_at_work(self) -> None:
        """First view: from the side, with the shaft and the cameras in the middle."""
        middle = 0.5 * (self._arms.end.mean(0) + self._arms.rcm.mean(0))
        others = [shown.cameras.base_T_camera["right"][:, :3, 3].mean(0) for shown in self._shown.values()]
        size = max(
            [float(np.linalg.norm(self._arms.rcm.mean(0) - middle)), *(np.linalg.norm(o - middle) for o in others)]
        )
        camera = self._server.initial_camera
        camera.look_at = tuple(middle)
        camera.position = tuple(middle + _BACK * size * np.array([1.0, -1.0, 0.6]))


def open_viewer(
    recording: str | Path,
    results: Mapping[str, str | Path] | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> Viewer:
    """Serve a recording folder with results of it.

    Args:
        recording: the folder.
        results: files, or folders that `calibrate` wrote, by the name to show.
        host, port: see `Viewer`.

    Raises:
        InputError, FileError: a file breaks its format.
    """
    read = {name: CalibrationResult.read(_result_file(Path(path))) for name, path in (results or {}).items()}
    return Viewer(load_recording(recording), read, host, port)


def _result_file(path: Path) -> Path:
    return path / "result.json" if path.is_dir() else path


def _quaternion(R: Float[np.ndarray, "3 3"]) -> tuple[float, float, float, float]:
    w, x, y, z = matrix_to_quat(torch.from_numpy(np.ascontiguousarray(R))).tolist()
    return w, x, y, z


def _turning_z_to(direction: Float[np.ndarray, "3"]) -> tuple[float, float, float, float]:
    """The shortest rotation that takes +z to a unit direction."""
    z = np.array([0.0, 0.0, 1.0])
    half = z + direction
    if np.linalg.norm(half) < 1e-6:
        return 0.0, 1.0, 0.0, 0.0
    half = half / np.linalg.norm(half)
    x, y, zz = np.cross(z, half)
    return float(z @ half), float(x), float(y), float(zz)
