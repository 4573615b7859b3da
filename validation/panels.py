"""Claim: SH shading and path tracing of the same file agree; README's table and pictures.

    python -m validation.panels [--quick] [--out DIR] [--scene NAME ...] [--reference-spp N]

runs ``compare`` on the scenes of this repository and on Mitsuba's own ``mi.cornell_box()`` saved as XML, with their own settings, and
writes ``panels.json`` and a picture for each into ``panels/``.
"""
from __future__ import annotations

import pathlib
import shutil
import tempfile

import mitsuba as mi

from mi_shlight.compare import compare
from validation import experiment
from validation.experiment import ROOT

SCENES = ("cornell_box", "plant", "sculpture", "floor", "mi.cornell_box")
LARGEST_ERROR = 0.015
"""Mean relative error that the README states, order 8."""


def scene_file(name: str, folder: pathlib.Path) -> pathlib.Path:
    """The scene's XML file; Mitsuba's box is written to `folder` as Mitsuba itself writes it."""
    if name != "mi.cornell_box":
        return ROOT / "scenes" / f"{name}.xml"
    path = folder / "cornell_box.xml"
    configuration = mi.parser.ParserConfig(mi.variant())
    mi.parser.write_file(mi.parser.parse_dict(configuration, mi.cornell_box()), str(path))
    return path


def main(arguments=None) -> None:
    options = experiment.options(__doc__, arguments, scene={"nargs": "+", "choices": SCENES, "default": SCENES, "help": "default: all"},
                                 reference_spp={"type": int, "default": 4096})
    mi.set_variant("llvm_ad_rgb")
    small = {}
    if options.quick:
        options.scene, options.reference_spp, small = ("floor",), 64, {"resx": 32, "resy": 32}
    (options.out / "panels").mkdir(exist_ok=True)
    rows = []
    print("| scene | mean relative error | noise of the reference | bias | bake | first render | render | times `direct` |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        for name in options.scene:
            scene = mi.load_file(str(scene_file(name, folder)), optimize=False, **small)
            report = compare(scene, folder, reference_spp=options.reference_spp, title=name)
            shutil.copy(folder / "panel.png", options.out / "panels" / f"{name}.png")
            rows.append({**report, "scene": name})
            errors, times = report["errors"], report["times"]
            cells = (f"{errors['mean_relative']:.2%}", f"{report['noise']['mean_relative']:.2%}", f"{errors['bias']:+.2%}",
                     *(f"{times[key]:.2f} s" for key in ("bake", "first_render", "sh")), f"{times['sh_over_direct']:.1f}")
            print(f"| {name} | {' | '.join(cells)} |", flush=True)
    lines = [experiment.verdict(f"{row['scene']}: mean relative error at most {LARGEST_ERROR:.1%}", row["errors"]["mean_relative"],
                                LARGEST_ERROR, text="{:.2%}") for row in rows]
    experiment.print_targets(lines)
    experiment.write(options.out / "panels.json", {"targets": lines, "scenes": rows}, options.quick)


if __name__ == "__main__":
    main()
