"""Write the report: one self-contained HTML page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template

from rmis_calib.io.atomic import atomic_write
from rmis_calib.io.outputs import check_file, is_report
from rmis_calib.report import content, evidence
from rmis_calib.report.overlays import DETECTED_RGB, PREDICTED_RGB, Overlay, embed
from rmis_calib.results import CalibrationResult

_NO_NOTES: Mapping[str, str] = MappingProxyType({})


def write_report(
    path: str | Path,
    result: CalibrationResult,
    overlays: Sequence[Overlay] = (),
    *,
    title: str,
    source: str,
    notes: Mapping[str, str] = _NO_NOTES,
) -> None:
    """Write the report of a calibration, whole or not at all; an earlier report there is replaced.

    The page loads nothing: pictures and plots are inside it. Every text is escaped. A result that failed its checks is
    shown as one: its transform, where there is one, is marked as not for use and is not offered for copying.

    Args:
        path: HTML file to write.
        result: what to report.
        overlays: frames with their contours drawn, in the order to show them.
        title: heading of the page.
        source: what was calibrated: a recording or an observations file.
        notes: further lines for the head of the page, such as errors against a known truth.

    Raises:
        OutputError: another file is there, or it cannot be written.
    """
    check_file(Path(path), is_report, overwrite=True)
    page = render_report(result, overlays, title=title, source=source, notes=notes)
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def template(name: str, *packages: str) -> Template:
    """A page of these packages, else of this one: its templates escape every text, and know every name they use."""
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package) for package in (*packages, "rmis_calib.report")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def render_report(
    result: CalibrationResult,
    overlays: Sequence[Overlay],
    *,
    title: str,
    source: str,
    notes: Mapping[str, str],
) -> str:
    """The page as text; arguments as for `write_report`."""
    return template("report.html").render(
        title=title,
        source=source,
        notes=notes,
        result=result,
        created=content.created(result),
        verdict=content.headline(result),
        right=content.pose("camera_right_T_arm", result.camera_right_T_arm),
        left=content.pose("camera_left_T_arm", result.camera_left_T_arm),
        uncertainty=content.uncertainty(result),
        usage=evidence.usage(result.motions),
        pictures=[embed(overlay) for overlay in overlays],
        detected_rgb=DETECTED_RGB,
        predicted_rgb=PREDICTED_RGB,
        residuals=evidence.residuals(result),
        head_point_errors=content.head_point_errors(result),
        observability=content.observability(result.observability),
        nuisances=content.nuisances(result),
        stereo=content.pose("camera_left_T_camera_right", result.camera_left_T_camera_right),
        config=content.plain_json(result.config),
        covariance=content.covariance_text(result.covariance),
    )
