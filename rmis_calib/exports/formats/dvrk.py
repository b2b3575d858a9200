"""dvrk: where the instrument's arm stands in the camera, as dvrk_camera_registration writes it and the dVRK reads it.

Source: dvrk_camera_registration, save_registration; sawIntuitiveResearchKit, share/schemas/dvrk-system-arm.schema.json
(`base_frame`) and mtsIntuitiveResearchKitSUJFixed.cpp (suj-fixed.json: four arms, by name). All hold
`camera_T_instrument_base`: metres, 4x4 rows. The dVRK counts camera axes as ISI does and takes the endoscope's tip for
the camera.
"""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rmis_calib.errors import InputError
from rmis_calib.exports.answer import Answer
from rmis_calib.exports.formats.markup import json_text, rows
from rmis_calib.exports.hand_eye import ISI_R_OPENCV
from rmis_calib.exports.settings import AXES_IN_WORDS, Side
from rmis_calib.io.configs import read_bytes

ARMS = ("PSM1", "PSM2", "PSM3")
_LARGEST = 1 << 20
_FRAGMENT = re.compile(r'^\s*"base[-_]frame"\s*:')


def content(answer: Answer) -> dict[str, str]:
    """Registrations in both dialects, suj-fixed.json where the camera's arm moves, and a README."""
    side, psm = answer.sides[0], answer.settings.instrument
    camera_T_instrument_base, camera = answer.camera_T_instrument_base(side), answer.hand_eye(side).camera
    files = registrations(answer, camera, camera_T_instrument_base)
    frame = {"reference_frame": _reference(answer, camera), "transform": rows(_isi(camera_T_instrument_base))}
    files[f"{psm}-base_frame.json"] = json_text({"base_frame": frame})
    suj = suj_measured_cp(answer, camera_T_instrument_base)
    if suj is not None:
        arms: list[dict[str, Any]] = [{"name": "ECM", "measured_cp": rows(np.eye(4))}]
        arms += [{"name": name} | ({"measured_cp": rows(suj)} if name == psm else {}) for name in ARMS]
        files["suj-fixed.json"] = json_text(_mark(answer) | {"arms": arms})
    files["README.txt"] = "\n".join([*_readme(answer, side, suj is not None), ""])
    return files


def registrations(answer: Answer, camera: str, camera_T_instrument_base: Float[np.ndarray, "4 4"]) -> dict[str, str]:
    """`<PSM>-registration-open-cv.json` and `<PSM>-registration-dVRK.json`.

    Raises:
        InputError: the instrument's arm has no name that the dVRK knows.
    """
    psm = answer.settings.instrument
    if psm not in ARMS:
        raise InputError(where="instrument", expected=f"one of {', '.join(ARMS)}", found=psm)
    reference, suj = _reference(answer, camera), suj_measured_cp(answer, camera_T_instrument_base)
    if suj is None:
        dvrk = registration_text(reference, _isi(camera_T_instrument_base))
    else:
        dvrk = json_text(_mark(answer) | {"name": psm, "measured_cp": rows(suj)})
    return {
        f"{psm}-registration-open-cv.json": registration_text(reference, camera_T_instrument_base),
        f"{psm}-registration-dVRK.json": dvrk,
    }


def registration_text(reference: str, camera_T_instrument_base: Float[np.ndarray, "4 4"]) -> str:
    """A registration in the dialect before dVRK 2.4, as an object of its own."""
    return json_text({"base-frame": {"reference-frame": reference, "transform": rows(camera_T_instrument_base)}})


def suj_measured_cp(
    answer: Answer, camera_T_instrument_base: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "4 4"] | None:
    """The instrument's base on the ECM's base with the ECM's tip taken for the camera; None where no arm holds it."""
    laparoscope_base_T_arm = answer.placed().laparoscope_base_T_arm()
    return None if laparoscope_base_T_arm is None else laparoscope_base_T_arm @ _isi(camera_T_instrument_base)


def read_registration(path: str | Path) -> tuple[str, Float[np.ndarray, "4 4"]]:
    """Name of the camera's frame and `camera_T_instrument_base`, m, of a registration in either dialect.

    Takes the fragment `"base-frame": {...}` too, which dvrk_camera_registration writes without an ECM. The axes are
    the file's: OpenCV in `...-open-cv.json`, ISI in `...-dVRK.json`.

    Raises:
        FileError: the file cannot be read.
        InputError: it holds no registration to a camera.
    """
    text = read_bytes(path, _LARGEST).decode("utf-8-sig", errors="replace")
    try:
        raw = json.loads("{" + text + "}" if _FRAGMENT.match(text) else text)
        frame = raw.get("base-frame") or raw["base_frame"]
        name = frame.get("reference-frame") or frame["reference_frame"]
        matrix = np.array(frame["transform"], dtype=np.float64)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        expected = "a dVRK registration: base-frame (or base_frame) with its reference frame and transform"
        raise InputError(where=str(path), expected=expected, found="something else") from error
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(where=f"{path}: transform", expected="4x4 finite numbers", found=f"shape {matrix.shape}")
    return str(name), matrix


def _isi(camera_T_instrument_base: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The same in the dVRK's camera axes."""
    isi_T_camera = np.eye(4)
    isi_T_camera[:3, :3] = ISI_R_OPENCV
    return isi_T_camera @ camera_T_instrument_base


def _reference(answer: Answer, camera: str) -> str:
    """Name of the camera's frame. It is the only word that every reader keeps, so it carries the warning."""
    return camera if answer.result.trustworthy else f"{camera}_NOT_TRUSTWORTHY"


def _mark(answer: Answer) -> dict[str, Any]:
    """A warning for objects without a frame's name, whose readers pass over other keys."""
    return {} if answer.result.trustworthy else {"about": "; ".join(answer.about())}


def _readme(answer: Answer, side: Side, has_suj: bool) -> list[str]:
    """What each file is; JSON has no place for it, and the dVRK refuses keys that it does not know."""
    psm, camera = answer.settings.instrument, answer.hand_eye(side).camera
    at = f"frame {answer.placed().frame} of the recording"
    lines = [
        *answer.about(),
        f"All transforms: pose of the base of {psm} in {camera} ({camera}_T_base: maps coordinates in the arm's base "
        f"to coordinates in {camera}; base_T_{camera} is its inverse), 4x4 rows, metres, with the arms as in {at}.",
        f"{psm}-registration-open-cv.json: axes {AXES_IN_WORDS['opencv']}.",
    ]
    if not has_suj:
        return [
            *lines,
            f"{psm}-registration-dVRK.json: axes {AXES_IN_WORDS['isi']}; for an arm in a console file before dVRK 2.4.",
            f"{psm}-base_frame.json: the same for the arm in a system file of dVRK 2.4 and later.",
        ]
    return [
        *lines,
        f"{psm}-registration-dVRK.json, suj-fixed.json: pose of the base of {psm} on the base of the ECM. The dVRK "
        f"takes the ECM's tip for the camera, axes {AXES_IN_WORDS['isi']}: so it holds where the ECM stood in {at}.",
        f"{psm}-base_frame.json: the base of {psm} in the camera itself, for a system file of dVRK 2.4 and later "
        "without an ECM; it holds while the camera stands where it did.",
        "suj-fixed.json has the four arms that the dVRK asks for; fill in measured_cp of the others.",
    ]
