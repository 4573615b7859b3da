"""The picture of a comparison: SH shading, path tracing, and their difference with a scale."""
from __future__ import annotations

import numpy as np

from .files import replacing


def require_matplotlib():
    """Return matplotlib with the Agg canvas ready, or raise ImportError that names the extra to install."""
    try:
        import matplotlib
        import matplotlib.backends.backend_agg
    except ImportError as error:
        raise ImportError("the comparison panel must be drawn with matplotlib, which is not installed. "
                          "Install it with: pip install 'mi-shlight[plot]'") from error
    return matplotlib


def srgb(image):
    """Linear colour to the sRGB transfer curve, clipped to [0, 1]."""
    linear = np.clip(image, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def draw_panel(path, image, reference, mask, report) -> None:
    """Write the PNG panel of `mi_shlight.compare.compare`.

    Parameters
    ----------
    path : str or os.PathLike
        PNG file to write.
    image, reference : numpy.ndarray, shape (H, W, 3)
        Linear colours. Both are shown with one exposure: the 99th percentile of the reference over `mask` maps to 0.9.
    mask : numpy.ndarray of bool, shape (H, W)
        Pixels that are compared; the others are grey in the difference.
    report : dict
        As `compare` returns it.
    """
    matplotlib = require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter

    exposure = 0.9 / max(float(np.percentile(reference[mask].max(axis=-1), 99)), 1e-12)
    difference = (image - reference).mean(axis=-1) / reference[mask].mean()
    limit = _round_up(float(np.percentile(np.abs(difference[mask]), 99.5)))
    height, width = mask.shape

    column = 4.0
    figure = Figure(figsize=(3 * column + 1.6, column * height / width + 1.1), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    settings, errors, noise, times = (report[key] for key in ("settings", "errors", "noise", "times"))
    axes[0].set_title(f"spherical harmonics, order {settings['order']}, {report['spp']} spp")
    axes[0].imshow(srgb(image * exposure))
    axes[1].set_title(f"path traced (direct light), {report['reference_spp']} spp")
    axes[1].imshow(srgb(reference * exposure))
    axes[2].set_title("difference: SH \N{MINUS SIGN} path traced")
    colours = matplotlib.colormaps["RdBu_r"].with_extremes(bad="0.6")
    shown = axes[2].imshow(np.ma.masked_where(~mask, difference), cmap=colours, vmin=-limit, vmax=limit, interpolation="nearest")
    bar = figure.colorbar(shown, ax=axes[2], extend="both", format=PercentFormatter(xmax=1, decimals=None if limit < 0.05 else 0))
    bar.set_label("of the reference's mean (grey: not compared)")
    for axis in axes:
        axis.set_xticks([])
        axis.set_yticks([])
    figure.suptitle(f"{report['scene']}: mean error {errors['mean_relative']:.2%} (noise of the reference "
                    f"{noise['mean_relative']:.2%}), 99 % of pixels within {errors['p99']:.1%} of the mean, bias {errors['bias']:+.2%}")
    figure.supxlabel(f"transfer {settings['transfer']} per {settings['transfer_domain']}; {report['size'][0]} x {report['size'][1]} "
                     f"pixels; {times_text(times, report['spp'])}; both images: exposure x{exposure:.3g}, sRGB", fontsize="medium")
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def times_text(times, spp) -> str:
    """One line with the times of a comparison in seconds."""
    return (f"bake {times['bake']:.2f} s, first render {times['first_render']:.2f} s; repeated {times['sh']:.2f} s = "
            f"{times['sh_over_direct']:.2f} x Mitsuba's direct ({times['direct']:.2f} s) at {spp} spp")


def _round_up(value) -> float:
    """The next of 1, 2, 5 times a power of ten, so that the colour bar has round ends."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-6)))
    return float(next(step * power for step in (1, 2, 5, 10) if value <= step * power * (1 + 1e-9)))
