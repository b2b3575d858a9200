"""Observations: what is accepted, how rows that do not count are marked, and what is refused."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rmis_calib.errors import FileError, ObservationsError, OutputError
from rmis_calib.io import observations
from rmis_calib.io.observations import OBSERVATION_KEYS, ShaftObservations

N = 6


def transforms(n: int = N, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    R, _ = np.linalg.qr(generator.normal(size=(n, 3, 3)))
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = R * np.sign(np.linalg.det(R))[:, None, None]
    T[:, :3, 3] = 100 + generator.normal(size=(n, 3))
    return T


def everything() -> dict[str, Any]:
    """Every key of the format."""
    generator = np.random.default_rng(1)
    v = generator.normal(size=(N, 3))
    extrinsics = np.eye(4)
    extrinsics[0, 3] = 5.0
    arrays: dict[str, Any] = {
        "arm_T_rcm": transforms(),
        "rcm_v_axis": v / np.linalg.norm(v, axis=1, keepdims=True),
        "camera_left_T_camera_right": extrinsics,
        "shaft_radius_mm": 4.2,
        "rcm_s_end_mm": 150 + generator.normal(size=N),
        "rcm_p_head": 160 + generator.normal(size=(N, 3)),
        "sigma_image": 1e-3,
        "sigma_edge_bias": 3e-5,
        "sigma_focal": 0.005,
        "sigma_centre": 0.003,
        "sigma_lens": 0.03,
        "laparoscope_base_T_arm": np.tile(np.eye(4), (N, 1, 1)),
        "laparoscope_base_T_instrument_base": np.eye(4),
        "sigma_setup_mm": 50.0,
        "sigma_setup_rad": 0.09,
        "sigma_rcm_mm": 0.5,
        "sigma_readout": 0.01,
        "unknown_names": np.array(["laparoscope.yaw_rad", "instrument.insertion_mm", "clock_s"]),
        "unknown_displacement": generator.normal(size=(N, 3, 6)),
        "unknown_at": np.array([0.001, 0.1, 0.02]),
        "unknown_sigma": np.array([0.002, 0.0, np.nan]),
    }
    levels = [f"sigma_{what}_{unit}" for what in ("kinematics", "camera", "stereo") for unit in ("mm", "rad")]
    arrays |= dict.fromkeys(levels, 0.0)
    for side in ("right", "left"):
        shapes = {"axis": (2, 2), "contour": (2, 2, 2), "end": (2,), "head": (2,)}
        arrays |= {f"{kind}_{side}": generator.normal(size=(N, *shape)) for kind, shape in shapes.items()}
        sigmas = {"axis": (), "contour": (2,), "end": (), "head": ()}
        arrays |= {f"sigma_{kind}_{side}": np.full((N, *shape), 1e-3) for kind, shape in sigmas.items()}
        arrays[f"end_kind_{side}"] = np.arange(N) % 2
        arrays[f"end_sureness_{side}"] = np.linspace(0.0, 1.0, N)
        arrays[f"valid_{side}"] = np.ones(N, dtype=bool)
    return arrays


def minimal() -> dict[str, Any]:
    arrays = everything()
    return {key: arrays[key] for key in ("arm_T_rcm", "rcm_v_axis", "axis_right")}


def test_the_example_covers_the_format() -> None:
    assert set(everything()) == set(OBSERVATION_KEYS)


def test_round_trip_keeps_every_key(tmp_path: Path) -> None:
    original = ShaftObservations(**everything())
    original.save(tmp_path / "obs.npz")
    loaded = ShaftObservations.load(tmp_path / "obs.npz")
    for key, value in everything().items():
        np.testing.assert_array_equal(getattr(loaded, key), value, err_msg=key)
    assert loaded.n_motions == N and loaded.has_left
    assert isinstance(loaded.shaft_radius_mm, float)
    assert [path.name for path in tmp_path.iterdir()] == ["obs.npz"]


def test_minimum_and_types() -> None:
    arrays = minimal()
    arrays["arm_T_rcm"] = arrays["arm_T_rcm"].tolist()
    observations = ShaftObservations.from_arrays(arrays)
    assert observations.valid_right is not None and observations.valid_right.all()
    assert observations.valid_left is None and not observations.has_left
    assert observations.arm_T_rcm.dtype == observations.axis_right.dtype == np.float64
    assert observations.axis_right is not arrays["axis_right"]
    single = {key: np.asarray(value, dtype=np.float32) for key, value in minimal().items()}
    assert ShaftObservations(**single).n_motions == N


def test_rows_that_do_not_count_are_nan() -> None:
    arrays = everything()
    arrays["axis_right"][0, 1, 0] = np.nan  # one number takes its row along
    arrays["contour_right"][1, 0, 0, 0] = np.nan
    arrays["valid_right"][2] = False
    arrays["arm_T_rcm"][3, 0, 0] = np.nan
    arrays["rcm_s_end_mm"][4] = np.nan
    arrays["axis_right"][2] = 0.0  # would be refused in a row that counts: the points coincide
    given = {key: np.copy(value) for key, value in arrays.items()}
    observations = ShaftObservations(**arrays)
    assert observations.valid_right is not None and observations.valid_left is not None
    assert observations.valid_right.tolist() == [True, True, False, False, True, True]
    assert observations.valid_left.tolist() == [True, True, True, False, True, True]
    nan_rows = {
        "axis_right": [0, 2, 3],
        "contour_right": [1, 2, 3],
        "end_right": [2, 3, 4],
        "head_right": [2, 3],
        "axis_left": [3],
        "end_left": [3, 4],
        "arm_T_rcm": [3],
    }
    for key, rows in nan_rows.items():
        is_nan = np.isnan(getattr(observations, key)).reshape(N, -1)
        assert is_nan.all(axis=1).tolist() == is_nan.any(axis=1).tolist() == [i in rows for i in range(N)], key
    for key, value in given.items():
        np.testing.assert_array_equal(arrays[key], value, err_msg="the caller's arrays stay as they are")


def test_a_motion_without_any_measurement_is_not_valid() -> None:
    arrays = minimal()
    arrays["axis_right"][4] = np.nan
    observations = ShaftObservations(**arrays)
    assert observations.valid_right is not None
    assert observations.valid_right.tolist() == [True, True, True, True, False, True]


def test_lines_may_be_given_by_points_far_out() -> None:
    arrays = minimal()
    arrays["axis_right"][0, 0] = [250.0, -80.0]
    ShaftObservations(**arrays)


def put(key: str, index: Any, value: Any) -> Any:
    def change(arrays: dict[str, Any]) -> None:
        arrays[key] = np.array(arrays[key])
        arrays[key][index] = value

    return change


def replace(key: str, value: Any) -> Any:
    return lambda arrays: arrays.update({key: value})


def scale(key: str, factor: float) -> Any:
    return lambda arrays: arrays.update({key: arrays[key] * factor})


def drop(*keys: str) -> Any:
    return lambda arrays: [arrays.pop(key) for key in keys]


LEFT = [key for key in OBSERVATION_KEYS if key.endswith("_left")]
BAD = {
    "shape of poses": (replace("arm_T_rcm", np.eye(4)), r"arm_T_rcm: expected shape \(N, 4, 4\)"),
    "no motions": (replace("arm_T_rcm", np.empty((0, 4, 4))), "with N > 0"),
    "another N": (replace("rcm_v_axis", np.ones((N + 1, 3))), r"rcm_v_axis: expected shape \(6, 3\), found \(7, 3\)"),
    "shape of lines": (
        replace("axis_right", np.ones((N, 4))),
        r"axis_right: expected shape \(6, 2, 2\), found \(6, 4\)",
    ),
    "shape of edges": (replace("sigma_contour_left", np.ones(N)), r"sigma_contour_left: expected shape \(6, 2\)"),
    "text": (replace("end_right", np.full((N, 2), "a")), "end_right: expected real numbers, found dtype <U1"),
    "objects": (replace("end_right", np.full((N, 2), None)), "expected real numbers, found dtype object"),
    "complex": (replace("end_right", np.ones((N, 2), complex)), "found dtype complex128"),
    "ragged": (replace("end_right", [[1.0, 2.0], [1.0]]), "end_right: expected an array of numbers, found ragged"),
    "infinity": (put("head_left", (2, 1), np.inf), r"head_left: expected finite numbers, .*found infinity at \[2, 1\]"),
    "sheared pose": (put("arm_T_rcm", (3, 0, 0), 2.0), r"arm_T_rcm\[3\]: expected an orthonormal rotation"),
    "mirrored pose": (scale("arm_T_rcm", -1.0), r"arm_T_rcm\[0\]: expected a rotation \(determinant \+1\)"),
    "last row": (
        put("arm_T_rcm", (5, 3, 0), 0.1),
        r"arm_T_rcm\[5\]: expected a last row of 0, 0, 0, 1, found \[0\.1, 0",
    ),
    "poses in metres": (put("arm_T_rcm", np.s_[:, :3, 3], 0.1), "arm_T_rcm: looks like metres; write millimetres"),
    "head in metres": (scale("rcm_p_head", 1e-3), "rcm_p_head: looks like metres"),
    "end in metres": (scale("rcm_s_end_mm", 1e-3), "rcm_s_end_mm: looks like metres"),
    "radius in metres": (replace("shaft_radius_mm", 0.0042), "shaft_radius_mm: looks like metres; .*found 0.0042"),
    "diameter for radius": (replace("shaft_radius_mm", 16.8), "expected a radius of 0.5 to 15.0 mm, found 16.8"),
    "negative radius": (replace("shaft_radius_mm", -4.0), "expected a radius of 0.5 to 15.0 mm, found -4"),
    "baseline in metres": (
        put("camera_left_T_camera_right", (0, 3), 0.005),
        "camera_left_T_camera_right: looks like metres",
    ),
    "sheared extrinsics": (
        put("camera_left_T_camera_right", (0, 1), 0.1),
        "camera_left_T_camera_right: expected an orth",
    ),
    "NaN extrinsics": (put("camera_left_T_camera_right", (0, 1), np.nan), "expected 16 finite numbers .*found NaN"),
    "many extrinsics": (replace("camera_left_T_camera_right", transforms()), r"of shape \(4, 4\), found \(6, 4, 4\)"),
    "axis not unit": (
        put("rcm_v_axis", 2, [0.0, 0.0, 1.001]),
        r"rcm_v_axis\[2\]: expected a unit vector, found length 1\.001",
    ),
    "axis zero": (put("rcm_v_axis", 1, 0.0), r"rcm_v_axis\[1\]: expected a unit vector, found length 0"),
    "points coincide": (
        put("axis_left", 4, 0.25),
        r"axis_left\[4\]: expected two points that differ, found \[0\.25, 0\.25\]",
    ),
    "edge points coincide": (put("contour_right", (1, 1), 0.5), r"contour_right\[1\]: expected two points that differ"),
    "one edge twice": (
        put("contour_right", 3, [[0.0, 1.0], [2.0, 3.0]]),
        r"contour_right\[3\]: expected two edges that",
    ),
    "offsets without names": (
        lambda arrays: arrays.pop("unknown_names"),
        "unknown_displacement: expected unknown_names beside it, found none",
    ),
    "an offset without a unit": (
        replace("unknown_names", np.array(["yaw", "instrument.insertion_mm", "clock_s"])),
        "unknown_names: expected clock_s, clock_rate, or a joint's name that ends in its unit, _rad or _mm, found",
    ),
    "an offset named twice": (
        replace("unknown_names", np.array(["clock_s", "instrument.insertion_mm", "clock_s"])),
        "unknown_names: expected different names in one row",
    ),
    "displacements of other offsets": (
        replace("unknown_displacement", np.zeros((N, 2, 6))),
        r"unknown_displacement: expected finite numbers of shape \(6, 3, 6\), found \(6, 2, 6\)",
    ),
    "negative sigma of an offset": (
        replace("unknown_sigma", np.array([0.1, -0.1, 0.0])),
        r"unknown_sigma: expected numbers of shape \(3,\), not negative",
    ),
    "displacements in degrees": (
        replace("unknown_displacement", np.full((N, 3, 6), 57.3)),
        "unknown_displacement: expected at most 6.3 rad and 10000 mm a unit",
    ),
    "pixels": (scale("axis_right", 800.0), "axis_right: looks like pixels; expected normalised x/z, y/z"),
    "negative sigma": (
        put("sigma_axis_right", 3, -1e-3),
        r"sigma_axis_right: expected positive .*found -0\.001 at \[3\]",
    ),
    "zero sigma": (put("sigma_end_left", 0, 0.0), "sigma_end_left: expected positive"),
    "infinite sigma": (put("sigma_head_left", 0, np.inf), "sigma_head_left: expected finite numbers"),
    "negative level": (
        replace("sigma_stereo_mm", -0.1),
        "sigma_stereo_mm: expected zero or a positive number, found -0.1",
    ),
    "NaN level": (replace("sigma_camera_rad", np.nan), "sigma_camera_rad: expected one finite number, found NaN"),
    "array for a level": (
        replace("sigma_kinematics_mm", np.ones(N)),
        r"expected one finite number, found shape \(6,\)",
    ),
    "image without noise": (replace("sigma_image", 0.0), "sigma_image: expected a positive number, found 0"),
    "shape of flags": (replace("valid_left", True), r"valid_left: expected shape \(6,\), found \(\)"),
    "odd flags": (replace("valid_right", np.arange(N)), "valid_right: expected true or false"),
    "contours alone": (drop("shaft_radius_mm"), "contour_right: expected shaft_radius_mm beside it, found none"),
    "ends alone": (drop("rcm_s_end_mm"), "end_right: expected rcm_s_end_mm beside it"),
    "heads alone": (drop("rcm_p_head"), "head_right: expected rcm_p_head beside it"),
    "left alone": (drop("camera_left_T_camera_right"), "a left array: expected camera_left_T_camera_right beside it"),
    "another kind of end": (
        put("end_kind_right", 2, 4),
        r"end_kind_right\[2\]: expected 0 \(tube\) or 1 \(ring\), found 4",
    ),
    "sureness in per cent": (
        put("end_sureness_left", 3, 80.0),
        r"end_sureness_left\[3\]: expected a probability, found 80",
    ),
    "kind alone": (drop("end_left", "sigma_end_left"), "end_kind_left: expected end_left beside it"),
    "sigma alone": (drop("end_right"), "sigma_end_right: expected end_right beside it"),
    "flags alone": (drop(*(key for key in LEFT if key != "valid_left")), "valid_left: expected an array measured in"),
}


@pytest.mark.parametrize("name", BAD)
def test_refused_in_one_line(name: str) -> None:
    change, message = BAD[name]
    arrays = everything()
    change(arrays)
    with pytest.raises(ObservationsError, match=message) as caught:
        ShaftObservations.from_arrays(arrays)
    assert "\n" not in str(caught.value)


def test_a_bad_row_that_does_not_count_is_not_refused() -> None:
    arrays = minimal() | {"valid_right": np.array([False, *[True] * (N - 1)])}
    arrays["axis_right"][0] = 0.0
    ShaftObservations(**arrays)


def test_numbering_of_bad_poses_counts_all_rows() -> None:
    arrays = minimal()
    arrays["arm_T_rcm"][0] = np.nan
    arrays["arm_T_rcm"][3, 0, 0] = 2.0
    with pytest.raises(ObservationsError, match=r"arm_T_rcm\[3\]"):
        ShaftObservations(**arrays)


def test_unknown_and_missing_keys(tmp_path: Path) -> None:
    path = tmp_path / "obs.npz"
    np.savez(path, **minimal(), axis_rihgt=np.ones(3))
    with pytest.raises(ObservationsError, match=r"obs\.npz: key 'axis_rihgt': .*did you mean axis_right\?"):
        ShaftObservations.load(path)
    np.savez(path, rcm_v_axis=minimal()["rcm_v_axis"])
    with pytest.raises(ObservationsError, match=r"obs\.npz: observations: expected keys .*found no arm_T_rcm"):
        ShaftObservations.load(path)


@pytest.mark.parametrize("kind", ["axis", "contour", "end", "head"])
@pytest.mark.parametrize("side", ["right", "left"])
def test_any_one_measurement_will_do(kind: str, side: str) -> None:
    arrays = everything()
    needs = ("arm_T_rcm", "rcm_v_axis", "camera_left_T_camera_right", "shaft_radius_mm", "rcm_s_end_mm", "rcm_p_head")
    one = ShaftObservations(**{key: arrays[key] for key in (*needs, f"{kind}_{side}")})
    assert one.has_left == (side == "left")
    assert one.valid_right is not None and one.valid_right.any() == (side == "right")


def test_nothing_measured_at_all_is_refused() -> None:
    arrays = everything()
    with pytest.raises(ObservationsError, match=r"something measured in a picture: any of axis, contour, end, head"):
        ShaftObservations(arm_T_rcm=arrays["arm_T_rcm"], rcm_v_axis=arrays["rcm_v_axis"])


@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.5, 0.99])
def test_truncated_file(tmp_path: Path, fraction: float) -> None:
    path = tmp_path / "obs.npz"
    ShaftObservations(**everything()).save(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * fraction)])
    with pytest.raises(ObservationsError, match=r"obs\.npz: expected a complete \.npz archive, found"):
        ShaftObservations.load(path)


def test_damaged_file(tmp_path: Path) -> None:
    path = tmp_path / "obs.npz"
    ShaftObservations(**everything()).save(path)
    data = bytearray(path.read_bytes())
    data[300:340] = bytes(40)
    path.write_bytes(bytes(data))
    with pytest.raises(ObservationsError, match="found a damaged one") as caught:
        ShaftObservations.load(path)
    assert "\n" not in str(caught.value)


def test_files_of_another_kind(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.ones(3))
    (tmp_path / "a.txt").write_text("hello")
    for name in ("a.npy", "a.txt"):
        with pytest.raises(ObservationsError, match="found another kind of file"):
            ShaftObservations.load(tmp_path / name)
    np.savez(tmp_path / "pickled.npz", allow_pickle=True, **minimal() | {"axis_right": np.array([{}, {}])})
    with pytest.raises(ObservationsError, match="damaged one .*allow_pickle"):
        ShaftObservations.load(tmp_path / "pickled.npz")
    with pytest.raises(FileError, match=r"none\.npz: expected a readable file, found nothing there"):
        ShaftObservations.load(tmp_path / "none.npz")
    with pytest.raises(FileError, match="found a folder"):
        ShaftObservations.load(tmp_path)


def test_unwritable_output(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="expected a writable place"):
        ShaftObservations(**minimal()).save(tmp_path / "none" / "obs.npz")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("sigma_image", 0.3, "sigma_image: looks like pixels; divide by the focal length"),
        ("sigma_edge_bias", 0.2, "sigma_edge_bias: looks like pixels"),
        ("sigma_centre", 3.0, "sigma_centre: looks like pixels"),
        ("sigma_axis_right", np.full(N, 0.4), "sigma_axis_right: looks like pixels"),
        ("sigma_kinematics_rad", 0.1, "sigma_kinematics_rad: looks like degrees; multiply by pi / 180"),
        ("sigma_stereo_rad", 0.5, "sigma_stereo_rad: looks like degrees"),
    ],
)
def test_sigmas_in_pixels_or_degrees_are_told_by_their_size(key, value, message) -> None:
    with pytest.raises(ObservationsError, match=message):
        ShaftObservations(**minimal(), **{key: value})


def test_honest_sigmas_are_kept() -> None:
    # 20 px at a focal length of 1000 px; the noise coefficient 2 of the paper.
    ShaftObservations(**minimal(), sigma_image=0.02, sigma_kinematics_rad=np.deg2rad(2.0), sigma_kinematics_mm=2.0)


def npy_header(shape: tuple[int, ...], descr: str = "<f8") -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def test_an_array_that_promises_more_than_it_holds_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "o.npz"
    minimal_file = tmp_path / "good.npz"
    np.savez(minimal_file, **minimal())
    with zipfile.ZipFile(minimal_file) as good, zipfile.ZipFile(path, "w") as archive:
        for name in good.namelist():
            content = npy_header((10**10, 4, 4)) + b"0" * 64 if name == "arm_T_rcm.npy" else good.read(name)
            archive.writestr(name, content)
    with pytest.raises(ObservationsError, match="arm_T_rcm: expected as many numbers as promised, found 64 bytes"):
        ShaftObservations.load(path)


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observations, "_LARGEST_BYTES", 1 << 22)
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("arm_T_rcm.npy", npy_header((64, 1 << 16)) + b"\0" * (1 << 25))  # 32 MB of zeros
    assert path.stat().st_size < 1 << 16
    monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("must refuse before it unpacks"))
    with pytest.raises(ObservationsError, match="expected arrays of 0.0039.* GB in all at most"):
        ShaftObservations.load(path)


def test_a_pickle_in_an_archive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "o.npz"
    np.savez(path, **minimal() | {"rcm_s_end_mm": np.array([object()], dtype=object)}, allow_pickle=True)
    with pytest.raises(ObservationsError):
        ShaftObservations.load(path)
