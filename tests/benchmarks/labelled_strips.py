"""Labelled strips that train_strip_network.py learns from: of rendered pictures, and painted ones.

The search has no part in it: rules of detection may change without the weights having to be made anew.
Right is a strip whose contours lie within a tenth of a width of a true shaft's, wrong one that is off by a quarter and
more of every one; others do not count. Pictures are rendered at the size of the small picture that the search sees.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from data_synth import SynthConfig, load_synth_config, paint_strips, render_bench, render_frames
from data_synth.clutter import draw_clutter
from data_synth.world import build_world
from rmis_calib.geometry import Camera
from rmis_calib.vision import DetectorSettings
from rmis_calib.vision.coarse.appearance import field_of_view
from rmis_calib.vision.coarse.straight_pictures import ACROSS, ALONG, MARGIN, channels, straighten_pictures
from rmis_calib.vision.coarse.strip_network import KINDS
from rmis_calib.vision.coarse.strips import Strips
from rmis_calib.vision.image.canvas import Canvas, plan_canvas, shrink
from rmis_calib.vision.image.pixel_mapping import Lens

HEIGHT, WIDTH = 240, 320
RIGHT, WRONG = 0.10, 0.25
FRAMES = 10
"""Pictures of a world, and benches of a group."""
PLACES, KEPT = 80, 4
"""Strips anywhere in one picture, and how many of them are kept, the darkest."""
PAINTED = 512
"""Strips painted at once."""
BORDER, HIDDEN = KINDS * ALONG, KINDS * ALONG + 1
HELD_OUT = ("cholec", "davinci_sd", "glare", "hard")
"""Presets that are not trained on."""
TRAINED_ON = (
    "absent", "barrel", "blood", "brutal", "carbon", "clean", "davinci_720", "davinci_986", "demo",
    "leaving", "mild", "smoke", "static", "theatre", "tissue", "two_instruments", "unlogged", "video",
)  # fmt: skip
"""Named one by one: another preset would change the strips."""


@dataclass
class Shaft:
    """The truth of one shaft in one picture; ideal pixels."""

    contour: np.ndarray
    """(edge, point, 2), RCM side first."""
    end: np.ndarray | None
    kind: int
    hidden: bool


@dataclass
class LabelledStrips:
    """m strips with their labels."""

    picture: Tensor
    """(m, 6, across, along) half precision, as the network takes them."""
    right: Tensor
    """1, 0, or -1 for neither."""
    forwards: Tensor
    """1, 0, or -1 where nobody can tell."""
    end: Tensor
    """Column of the end, kind * ALONG + column; BORDER, HIDDEN, or -1 for strips that are no shaft."""

    @classmethod
    def joined(cls, parts: "list[LabelledStrips]") -> "LabelledStrips":
        return cls(*(torch.cat([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(cls)))

    def of(self, which: Tensor) -> "LabelledStrips":
        return LabelledStrips(*(getattr(self, f.name)[which] for f in dataclasses.fields(self)))


def random_config(generator: np.random.Generator, seed: int, presets: tuple[str, ...]) -> SynthConfig:
    """One of the presets with its look, camera and motion drawn anew."""
    config = load_synth_config(str(generator.choice(presets)))
    look, camera = config.look, config.camera

    def some(share: float, value: object, usual: object) -> object:
        return value if generator.random() < share else usual

    look = dataclasses.replace(
        look,
        tissue=some(0.5, str(generator.choice(["mixed", "liver", "bowel"])), look.tissue),
        brightness=look.brightness * float(np.exp(generator.normal(0, 0.25))),
        fat=some(0.5, float(generator.uniform(0, 0.5)), look.fat),
        folds=some(0.5, float(generator.uniform(0, 0.9)), look.folds),
        gloss=some(0.5, float(generator.uniform(0, 1.8)), look.gloss),
        blood=some(0.4, float(generator.uniform(0, 0.6)), look.blood),
        cavities=some(0.5, float(generator.uniform(0, 0.3)), look.cavities),
        smoke=some(0.3, float(generator.uniform(0, 0.6)), look.smoke),
        shaft=some(0.5, str(generator.choice(["dark_grey", "carbon", "anodised", "slate"])), look.shaft),
        glare=some(0.5, float(np.exp(generator.uniform(-1, 3))), look.glare),
        wrist_radius_ratio=float(generator.uniform(0.8, 1.0)),
        other_instruments=some(
            0.5, tuple(generator.choice(["metal", "dark", "white"], generator.choice(3))), look.other_instruments
        ),
        tissue_over_shaft=bool(some(0.2, True, look.tissue_over_shaft)),
        absent_fraction=float(some(0.2, 0.5, look.absent_fraction)),
    )
    scale = WIDTH / camera.width_px  # the network sees the small picture only
    lens = camera.right
    lens = dataclasses.replace(
        lens, fx_px=lens.fx_px * scale, fy_px=lens.fy_px * scale, cx_px=lens.cx_px * scale, cy_px=lens.cy_px * scale
    )
    camera = dataclasses.replace(
        camera, left=None, right=lens, width_px=WIDTH, height_px=round(camera.height_px * scale),
        blur_px=float(generator.uniform(0.3, 1.1)), noise_levels=float(generator.uniform(0.3, 4.0)),
        jpeg_quality=some(0.5, int(generator.integers(60, 96)), camera.jpeg_quality),
        vignette=float(generator.uniform(0, 0.9)), gain_variation=0.1, white_balance_variation=0.1,
    )  # fmt: skip
    motion = dataclasses.replace(
        config.motion, keep_end_in_view=bool(generator.random() < 0.5),
        rotation_range_deg=float(generator.uniform(10, 25)), translation_range_mm=float(generator.uniform(20, 50)),
    )  # fmt: skip
    return dataclasses.replace(config, seed=seed, motions=FRAMES, look=look, camera=camera, motion=motion)


def theatre(config: SynthConfig) -> tuple[Tensor, list[list[Shaft]], Camera]:
    """Pictures of an operating scene and the truth of each."""
    images, truth = render_frames(config)
    own = build_world(config).cameras["right"].to_dict()
    k = [own[name] for name in ("fx", "fy", "cx", "cy")]
    camera = Camera.from_values(*k, own["distortion"], image_size=tuple(images.shape[-2:]))
    focal, centre = np.array(k[:2]), np.array(k[2:])
    pictures: list[list[Shaft]] = []
    for frame in range(len(images)):
        shafts = []
        for t in (truth, *truth.others):
            if not t.visible[frame]:
                continue
            contour = t.contour_xy[frame] * focal + centre
            end, uv = t.end_front_xy[frame] * focal + centre, t.end_front_uv[frame]
            inside = bool(t.end_visible[frame])
            # Truth has no place for ends that are not seen: hidden ones are those that stop inside the picture.
            last = t.contour_uv[frame][t.contour_visible[frame]][-1:] if t.contour_visible[frame].any() else uv[None]
            size = np.array(images.shape[:1:-1])
            hidden = not inside and bool(((last > 6) & (last < size - 7)).all())
            shafts.append(Shaft(contour, end if inside else None, 0, hidden))
        pictures.append(shafts)
    return images, pictures, camera


def bench(seed: int, count: int) -> tuple[Tensor, list[list[Shaft]]]:
    """The same of benches."""
    images, truth = render_bench(seed, count, HEIGHT, WIDTH)
    size = np.array(images.shape[:1:-1])
    pictures = []
    for shafts in truth:
        listed = []
        for s in shafts:
            inside = bool(((s.end_uv > 0) & (s.end_uv < size - 1)).all())
            if s.visible:
                listed.append(Shaft(s.contour_uv, s.end_uv if inside else None, int(s.ring), False))
        pictures.append(listed)
    return images, pictures


def label(strips: Strips, ends: Tensor, i: int, k: int, shafts: list[Shaft]) -> tuple[int, int, int]:
    """Right or not, forwards or not, and where the end is, of strip k of picture i."""
    along, left, origin = (x[i, k].double().numpy() for x in (strips.along, strips.left, strips.origin))
    offset, slope = (x[i, k].double().numpy() for x in (strips.offset, strips.slope))
    low, high = (float(e) for e in ends[i, k])
    nearest, best = np.inf, None
    for shaft in shafts:
        t, y = (shaft.contour - origin) @ along, (shaft.contour - origin) @ left
        for order in (slice(None), slice(None, None, -1)):
            expected = offset[:, None] + slope[:, None] * t[order]
            width = np.maximum(np.abs(y[0] - y[1]), 1.0)
            off = float((np.abs(y[order] - expected) / width).max())
            if off < nearest:
                nearest, best = off, shaft
    if best is None or nearest > WRONG:
        return 0, -1, -1
    right = 1 if nearest < RIGHT else -1
    middle = (best.contour.mean(0) - origin) @ along
    forwards = int(middle[1] > middle[0])
    if best.end is None:
        return right, -1 if not best.hidden else forwards, HIDDEN if best.hidden else BORDER
    column = round((float((best.end - origin) @ along) - low) / max(high - low, 1.0) * (ALONG - 1))
    inside = 0 <= column < ALONG
    return right, forwards, best.kind * ALONG + column if inside else BORDER


def strips_of(
    images: Tensor, truth: list[list[Shaft]], camera: Camera | None, generator: torch.Generator
) -> LabelledStrips:
    """The true strips displaced little and much, and places elsewhere that look most like a shaft."""
    canvas = plan_canvas((images.shape[2], images.shape[3]), 1, Lens(camera), images.device)
    small = shrink(images, 1)
    field, _ = field_of_view(small, DetectorSettings().black_level, 0)
    layers = canvas.lay_out(torch.cat([small, field[:, None].to(small.dtype)], 1))
    rgb, seen = layers[:, :3], layers[:, 3] > 0.5
    if canvas.covered is not None:
        seen &= canvas.covered
    made, anywhere = displaced(truth, generator), somewhere(len(images), canvas, generator)
    strips = Strips(**{name: torch.cat([value, getattr(anywhere, name)], 1) for name, value in vars(made).items()})
    width = strips.offset[..., :1] - strips.offset[..., 1:]
    jitter = 0.03 * width * torch.randn(strips.offset.shape, generator=generator)
    strips = dataclasses.replace(strips, offset=strips.offset + jitter)
    straight, ends = straighten_pictures(rgb, seen.float(), canvas, strips, strips.frame)
    straight = straight.unflatten(0, strips.valid.shape)
    own = made.valid.shape[1]
    kept: list[tuple[int, int, tuple[int, int, int]]] = []
    for i, shafts in enumerate(truth):
        dark = own + darkest(straight[i, own:])
        for k in [*range(own), *dark.tolist()]:
            if bool(strips.valid[i, k]):
                kept.append((i, k, label(strips, ends, i, k, shafts)))
    kept = [row for row in kept if row[2][0] >= 0 or row[2][2] >= 0]
    i, k = (torch.tensor([row[n] for row in kept], dtype=torch.int64) for n in (0, 1))
    values = torch.tensor([row[2] for row in kept], dtype=torch.int64).reshape(-1, 3)
    return LabelledStrips(straight[i, k].half(), *values.unbind(1))


def darkest(straight: Tensor) -> Tensor:
    """Which few (n,) of k strips (k, 6, across, along) are darkest against what lies on the brighter and on the darker
    side of them; and one of the others."""
    bright, known = straight[:, :3].mean(1), straight[:, 3]
    row = torch.linspace(MARGIN, -MARGIN, ACROSS)

    def mean(rows: Tensor) -> Tensor:
        return (bright * known)[:, rows].sum((1, 2)) / known[:, rows].sum((1, 2)).clamp(min=1.0)

    inside, left, right = mean(row.abs() < 0.42), mean(row > 0.58), mean(row < -0.58)
    contrast = torch.minimum(left, right) - inside + 0.2 * (torch.maximum(left, right) - inside)
    order = contrast.argsort(descending=True, stable=True)
    return order[[*range(KEPT), KEPT + 20]]


def somewhere(count: int, canvas: Canvas, generator: torch.Generator) -> Strips:
    """Strips anywhere in each picture, as wide as shafts are."""
    shape = (count, PLACES)

    def draw(low: float, high: float, *more: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, *more, generator=generator)

    angle, (height, width) = draw(0.0, 2 * np.pi), canvas.size
    along = torch.stack([angle.cos(), angle.sin()], -1)
    origin = draw(0.1, 0.9, 2) * torch.tensor([float(width), float(height)]) + torch.tensor(canvas.origin)
    half = 0.5 * width * draw(np.log(0.03), np.log(0.22)).exp()
    slope = 0.03 * torch.randn(*shape, 2, generator=generator)
    number = torch.arange(count)[:, None].expand(shape)
    return Strips(number, origin, along, torch.stack([half, -half], -1), slope, torch.ones(shape, dtype=torch.bool))


def displaced(truth: list[list[Shaft]], generator: torch.Generator) -> Strips:
    """Strips on the true contours, five a shaft; and two that hold half of it, more than it, or lie beside it."""
    most = 7 * max((len(shafts) for shafts in truth), default=0)
    origin, along, offset, slope = (torch.zeros(len(truth), most, 2) for _ in range(4))
    valid = torch.zeros(len(truth), most, dtype=torch.bool)
    along[..., 0] = 1.0
    for i, shafts in enumerate(truth):
        for j, shaft in enumerate(shafts):
            contour = torch.as_tensor(shaft.contour, dtype=torch.float32)
            middle = contour.mean(0)
            direction = torch.nn.functional.normalize(middle[1] - middle[0], dim=0)
            left = torch.stack([direction[1], -direction[0]])
            t, y = (contour - middle.mean(0)) @ direction, (contour - middle.mean(0)) @ left
            tilt = (y[:, 1] - y[:, 0]) / (t[:, 1] - t[:, 0])
            start = y[:, 0] - tilt * t[:, 0]
            width = start[0] - start[1]
            for n in range(7):
                k, shift = 7 * j + n, torch.zeros(2)
                if n > 4:  # one contour, or both, are moved by a third to one width
                    which = int(torch.randint(3, (1,), generator=generator))
                    size = (0.3 + 0.7 * torch.rand(1, generator=generator)) * width
                    size = size * (1 - 2 * torch.randint(2, (1,), generator=generator))
                    shift = torch.stack([size if which != 1 else 0 * size, size if which != 0 else 0 * size])[:, 0]
                origin[i, k], along[i, k], slope[i, k] = middle.mean(0), direction, tilt
                offset[i, k] = start + shift
                valid[i, k] = bool(offset[i, k, 0] - offset[i, k, 1] > 0.25 * width)
    return Strips(torch.arange(len(truth))[:, None].expand_as(valid), origin, along, offset, slope, valid)


def of_world(seed: int, number: int, presets: tuple[str, ...]) -> LabelledStrips:
    """Strips of a few pictures of one operating scene."""
    images, truth, camera = theatre(random_config(np.random.default_rng([seed, number]), seed + number, presets))
    return strips_of(images, truth, camera, torch.Generator().manual_seed(seed + number))


def of_benches(seed: int, number: int) -> LabelledStrips:
    """Strips of a few benches."""
    images, truth = bench(seed + 1_000_000 + number, FRAMES)
    return strips_of(images, truth, None, torch.Generator().manual_seed(seed + number))


def backgrounds(seed: int, benches: int, worlds: int) -> Tensor:
    """Pictures (n, 3, H, W), 0 to 1, without instruments: one of each bench, three of each operating scene."""
    pictures = [
        torch.from_numpy(draw_clutter(np.random.default_rng([seed, 5, i]), HEIGHT, WIDTH)) for i in range(benches)
    ]
    listed = [torch.stack(pictures).movedim(-1, 1)] if pictures else []
    for i in range(worlds):
        config = random_config(np.random.default_rng([seed, 6, i]), seed + i, TRAINED_ON)
        empty = dataclasses.replace(config.look, absent_fraction=1.0, other_instruments=())
        camera = dataclasses.replace(config.camera, height_px=HEIGHT)
        listed.append(render_frames(dataclasses.replace(config, look=empty, camera=camera), 3)[0].float() / 255)
    return torch.cat(listed)


def painted(seed: int, pictures: Tensor, count: int) -> LabelledStrips:
    """Strips painted over pieces of these pictures."""
    generator, parts = torch.Generator().manual_seed(seed), []
    for first in range(0, count, PAINTED):
        made = paint_strips(pictures, min(PAINTED, count - first), generator)
        column = made.end.round().long()
        end = torch.where(column < ALONG, made.ring * ALONG + column, BORDER)
        end = torch.where(made.fits, torch.where(made.hidden, HIDDEN, end), -1)
        straight = channels(made.picture, made.known, made.columns_per_width)
        told = torch.where(made.fits & (end != BORDER), 1, -1)
        parts.append(LabelledStrips(straight.half(), made.fits.long(), told, end))
    return LabelledStrips.joined(parts)
