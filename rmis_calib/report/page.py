"""Write the report: one self-contained HTML page."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template

from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io.atomic import atomic_write
from rmis_calib.io.outputs import check_file, is_report
from rmis_calib.report.drawing.marks import STYLES, Style, arrow_head
from rmis_calib.report.drawing.overlays import Overlay, Picture, embed
from rmis_calib.report.material import ReportMaterial
from rmis_calib.report.words import answer, details
from rmis_calib.report.words.directions import observability
from rmis_calib.report.words.formatting import significant
from rmis_calib.report.words.usage import usage
from rmis_calib.report.words.verdict import verdict
from rmis_calib.results import CalibrationResult

_NO_NOTES: Mapping[str, str] = MappingProxyType({})
_SMALL_PX = 480
"""Width of the pictures of rejected motions."""


@dataclass(frozen=True)
class PictureGroup:
    """Pictures under one heading."""

    title: str
    words: str
    pictures: tuple[Picture, ...]


def write_report(
    path: str | Path,
    result: CalibrationResult,
    material: ReportMaterial | None = None,
    *,
    title: str,
    source: str,
    notes: Mapping[str, str] = _NO_NOTES,
) -> None:
    """Write the report of a calibration, whole or not at all; an earlier report there is replaced.

    The page loads nothing: pictures, drawings and its script are inside it. Every text is escaped. A result that failed
    its checks is shown as one: its transform, where there is one, is marked as not for use and is not offered for
    copying.

    Args:
        path: HTML file to write.
        result: what to report.
        material: pictures and drawings (`gather_material`); without it the page says what the result says.
        title: heading of the page.
        source: what was calibrated: a recording or an observations file.
        notes: further lines for the head of the page, such as errors against a known truth.

    Raises:
        OutputError: another file is there, or it cannot be written.
    """
    check_file(Path(path), is_report, overwrite=True)
    page = render_report(result, material or ReportMaterial(), title=title, source=source, notes=notes)
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
    environment.globals |= {"styles": STYLES, "arrow_head": arrow_head}
    environment.filters["sig"] = significant
    return environment.get_template(name)


def render_report(
    result: CalibrationResult, material: ReportMaterial, *, title: str, source: str, notes: Mapping[str, str]
) -> str:
    """The page as text; arguments as for `write_report`."""
    right = result.camera_right_T_arm
    shown = _pictures(material)
    rejected = [(sheet, tuple(embed(overlay, _SMALL_PX) for overlay in sheet.overlays)) for sheet in material.sheets]
    point = material.working_point
    unknowns = details.unknowns(result)
    return template("report.html").render(
        title=title,
        source=source,
        notes=notes,
        result=result,
        created=details.created(result),
        verdict=verdict(result),
        right=answer.pose("camera_right_T_arm", right),
        right_back=answer.pose(*_inverse(right)),
        left=answer.pose("camera_left_T_arm", result.camera_left_T_arm),
        left_back=answer.pose(*_inverse(result.camera_left_T_arm)),
        uncertainty=answer.uncertainty(result),
        back_sigma_mm=answer.back_sigma_mm(result),
        point=point,
        point_picture=None if point is None else embed(point.overlay),
        scene=material.scene,
        shown=shown,
        rejected=rejected,
        legend=_legend(shown, [pictures for _, pictures in rejected]),
        residuals=material.residuals,
        edge_maps=material.edge_maps,
        picture_rows=details.picture_rows(result),
        residual_sizes=details.residual_sizes(result),
        shaft_ends=details.shaft_ends(result),
        groups=details.groups(result),
        tests=details.residual_tests(result),
        head_point_errors=details.head_point_errors(result),
        usage=usage(result),
        observability=observability(result.observability),
        unknowns=unknowns,
        unknowns_summary=details.unknowns_summary(unknowns),
        stereo=answer.pose("camera_left_T_camera_right", result.camera_left_T_camera_right),
        config=details.plain_json(result.config),
        covariance=answer.covariance_text(result.covariance),
    )


def _inverse(transform: RigidTransform | None) -> tuple[str, RigidTransform | None]:
    """The answer the other way round, with its name."""
    return ("", None) if transform is None else (f"{transform.src}_T_{transform.dst}", transform.inverse())


def _pictures(material: ReportMaterial) -> tuple[PictureGroup, ...]:
    worst, typical = _each(material.worst), _each(material.typical)
    usual = ("Typical", "Residuals near the median, in places far from each other.")
    if not worst:
        usual = ("Usable", "What was found, in places far from each other.")
    groups = (
        PictureGroup("Worst", "Used motions with the largest residuals, in the camera where they are largest.", worst),
        PictureGroup(*usual, typical),
    )
    return tuple(group for group in groups if group.pictures)


def _each(overlays: tuple[Overlay, ...]) -> tuple[Picture, ...]:
    return tuple(embed(overlay) for overlay in overlays)


def _legend(groups: tuple[PictureGroup, ...], sheets: list[tuple[Picture, ...]]) -> dict[str, Style]:
    """The styles of everything that is drawn, in their order."""
    pictures = [picture for group in groups for picture in group.pictures] + [p for sheet in sheets for p in sheet]
    present = {mark.style for picture in pictures for mark in picture.marks}
    return {name: style for name, style in STYLES.items() if name in present}
