"""Claim: SH shading and path tracing of the same file agree; README's table and pictures.

Runs ``compare`` on the scenes of this repository and on Mitsuba's own ``mi.cornell_box()`` saved as XML, with their own
settings, and writes panels and reports to ``validation/results/panels/``.

    python -m validation.panels [SCENE ...]
"""
from __future__ import annotations

import argparse
import json
import os
import pathlib
import platform
import shutil
import tempfile

import mitsuba as mi

import mi_shlight
from mi_shlight.compare import compare

ROOT = pathlib.Path(__file__).parents[1]
RESULTS = ROOT / "validation" / "results" / "panels"
SCENES = ("cornell_box", "plant", "sculpture", "floor", "mi.cornell_box")


def scene_file(name: str, folder: pathlib.Path) -> pathlib.Path:
    """The scene's XML file; Mitsuba's box is written to `folder` as Mitsuba itself writes it."""
    if name != "mi.cornell_box":
        return ROOT / "scenes" / f"{name}.xml"
    path = folder / "cornell_box.xml"
    configuration = mi.parser.ParserConfig(mi.variant())
    mi.parser.write_file(mi.parser.parse_dict(configuration, mi.cornell_box()), str(path))
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="*", choices=[*SCENES, []], help="default: all")
    parser.add_argument("--reference-spp", type=int, default=4096)
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    RESULTS.mkdir(parents=True, exist_ok=True)
    table = []
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        for name in arguments.scene or SCENES:
            scene = mi.load_file(str(scene_file(name, folder)), optimize=False)
            report = compare(scene, folder, reference_spp=arguments.reference_spp, title=name)
            shutil.copy(folder / "panel.png", RESULTS / f"{name}.png")
            report["versions"] = {"mi_shlight": mi_shlight.__version__, "mitsuba": mi.__version__, "machine": platform.processor() or
                                  platform.machine(), "cores": os.cpu_count()}
            (RESULTS / f"{name}.json").write_text(json.dumps(report, indent=2) + "\n")
            errors, times = report["errors"], report["times"]
            table.append(f"| {name} | {errors['mean_relative']:.2%} | {report['noise']['mean_relative']:.2%} | {errors['bias']:+.2%} | "
                         f"{times['bake']:.1f} s | {times['first_render']:.2f} s | {times['sh']:.2f} s | {times['sh_over_direct']:.1f} |")
    print("| scene | mean relative error | noise of the reference | bias | bake | first render | render | times `direct` |")
    print("|---|---|---|---|---|---|---|---|")
    print("\n".join(table))


if __name__ == "__main__":
    main()
