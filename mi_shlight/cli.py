"""The command ``mi-shlight``: render, animate, bake, plan and compare scenes from a shell.

Mitsuba's own command is a C++ program and cannot load plugins written in Python; this one takes its place. Every failure that
the user can mend is one paragraph on stderr and exit code 2; an interrupt ends with 130, a bug with 1. Output files appear
complete or not at all.
"""
from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import sys
import time
import warnings
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import mi_shlight

from .errors import SHLightWarning, check_integer, check_number, message
from .files import check_output

DEFAULT_VARIANT = "llvm_ad_rgb"

# Keywords of mitsuba.load_file that are no values of a scene.
LOADER_ARGUMENTS = ("path", "parallel", "optimize")

# Errors that speak about the user's input or machine; any other type is a bug of ours.
USER_ERRORS = (ValueError, TypeError, OSError, RuntimeError, ImportError, MemoryError)


def main(argv=None) -> int:
    """Run the command line.

    Parameters
    ----------
    argv : list of str, optional
        Arguments without the program's name; by default those of the process.

    Returns
    -------
    code : int
        0 success, 1 internal error, 2 an input or a machine that cannot be used, 130 interrupted.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    debug = "--traceback" in argv or bool(os.environ.get("MI_SHLIGHT_DEBUG"))
    try:
        arguments = _parser().parse_args(argv)
        with _one_line_warnings():
            arguments.run(arguments)
        return 0
    except (Exception, KeyboardInterrupt) as error:
        cause = root_cause(error)
        if isinstance(cause, KeyboardInterrupt):
            print(f"\nmi-shlight: interrupted; {str(cause) or 'no output was written'}", file=sys.stderr)
            return 130
        if debug:
            raise
        if isinstance(cause, USER_ERRORS) or type(cause) is Exception:  # Mitsuba raises plain Exception, too
            print(f"mi-shlight: error: {paragraph(cause)}", file=sys.stderr)
            return 2
        print(f"mi-shlight: internal error: {type(cause).__name__}: {paragraph(cause)} This is a bug: please report it with "
              "what --traceback prints.", file=sys.stderr)
        return 1


# ---- commands


def _render(arguments) -> None:
    from .exr import write_exr
    from .rendering import check_view, render, sh_integrator

    output = check_output("render", "-o", arguments.output, ".exr")
    scene = _load(arguments)
    _, spp = check_view(scene, arguments.sensor, arguments.spp, arguments.seed)
    integrator = sh_integrator(scene, _overrides(arguments))
    _announce(arguments, scene, integrator)
    start = time.perf_counter()
    integrator.prepare_scene(scene, _progress(arguments, "bake"))
    bake_seconds = time.perf_counter() - start
    start = time.perf_counter()
    image, names = render(scene, integrator, sensor=arguments.sensor, spp=spp, seed=arguments.seed,
                          progress=_progress(arguments, "render"))
    seconds = time.perf_counter() - start
    metadata = {**_metadata(arguments), **integrator.parameters(), "spp": spp, "seed": arguments.seed}
    write_exr(output, {name: image[..., k] for k, name in enumerate(names)}, metadata)
    _say(arguments, f"{output}: {image.shape[1]} x {image.shape[0]}, {spp} spp, {seconds:.2f} s after {bake_seconds:.2f} s of preparation")


def _animate(arguments) -> None:
    from .animation import MAX_FRAMES, VIDEO, Stage, video_command, write_frame, write_video
    from .motion import load_motion
    from .rendering import check_view, sh_integrator

    frames = check_integer("animate", "--frames", arguments.frames, 1, MAX_FRAMES)
    exposure = check_number("animate", "--exposure", arguments.exposure, 0, hint="Pictures are multiplied by it.")
    fps = check_number("animate", "--fps", arguments.fps, 0.01, 1000, "It is the number of frames per second.")
    folder = _results_folder("animate", arguments.output)
    digits = max(4, len(str(frames - 1)))
    _refuse_later_frames(folder, frames)
    motion = load_motion(arguments.motion)
    scene = _load(arguments)
    _, spp = check_view(scene, arguments.sensor, arguments.spp, arguments.seed)
    stage = Stage(scene, motion, frames)
    integrator = sh_integrator(scene, _overrides(arguments))
    margin = integrator.light_margin
    integrator = stage.integrator(integrator, one_bake=arguments.light_margin is None)
    _announce(arguments, scene, integrator)
    if integrator.light_margin > margin:
        _say(arguments, f"lights move by up to {integrator.light_margin:.4g}: light_margin is set so that one bake serves all frames; "
             "shadows are more exact with --light-margin 0 (a bake for each frame) or --transfer-domain pixel")
    folder.mkdir(exist_ok=True)
    done, start = 0, time.perf_counter()
    try:
        bars = {label: _progress(arguments, label) for label in ("bake", "frames")}
        for frame, image in stage.render(integrator, arguments.sensor, spp, arguments.seed, lambda label, *counts: bars[label](*counts)):
            write_frame(folder / f"frame_{frame:0{digits}}.png", image, exposure)
            done += 1
    except BaseException as error:
        if not done:
            _remove_empty(folder)
            raise
        report = f"{done} of {frames} frames are complete in {folder}"
        if isinstance(root_cause(error), KeyboardInterrupt):
            raise KeyboardInterrupt(report) from None
        print(f"mi-shlight: {report}", file=sys.stderr, flush=True)
        raise
    seconds = time.perf_counter() - start
    _say(arguments, f"{folder}: {frames} frames of {image.shape[1]} x {image.shape[0]}, {spp} spp, {seconds:.2f} s")
    pattern = f"frame_%0{digits}d.png"
    if video := write_video(folder, pattern, frames, fps):
        _say(arguments, f"{video}: {frames / fps:.2f} s at {fps:g} frames per second")
    else:
        command = shlex.join(video_command(str(folder / pattern), str(folder / VIDEO), frames, fps))
        _say(arguments, f"no video, as ffmpeg was not found. Where it is, make one with: {command}")


def _refuse_later_frames(folder, frames) -> None:
    """Frames beyond the last of a new animation would be taken for its own."""
    later = [file.name for file in folder.glob("frame_*.png") if file.stem[6:].isdigit() and int(file.stem[6:]) >= frames]
    if later:
        raise ValueError(message("animate", "-o", f"hold no frames beyond the {frames} to render", max(later),
                                 f"Delete what is left of a longer animation in '{folder}', or choose another folder."))


def _bake(arguments) -> None:
    from .rendering import sh_integrator

    output = check_output("bake", "-o", arguments.output)
    scene = _load(arguments)
    integrator = sh_integrator(scene, {"transfer": "shadowed", **_overrides(arguments), "transfer_domain": "vertex",
                                       "transfer_file": ""})
    start = time.perf_counter()
    transfer = integrator.prepare_scene(scene, _progress(arguments, "bake"))
    seconds = time.perf_counter() - start
    if transfer is None:
        hint = "Choose 'shadowed' or 'exact'."
        raise ValueError(message("bake", "--transfer", "name a transfer that is baked", arguments.transfer, hint))
    transfer.save(output)
    groups, points, _ = transfer.coeffs.shape
    _say(arguments, f"{output}: {points} points, {groups} light groups, order {transfer.order}, {transfer.samples} rays per point; "
         f"{output.stat().st_size / 2**20:.1f} MiB, {seconds:.2f} s")


def _plan(arguments) -> None:
    from .planner.apply import apply_settings
    from .planner.plan import plan
    from .shading.settings import Settings

    source, output = Path(arguments.scene), None
    if arguments.apply is not None:
        output = check_output("plan", "--apply", arguments.apply or source.with_name(f"{source.stem}_planned.xml"), ".xml")
    scene = _load(arguments)
    found = plan(scene, arguments.max_error, arguments.time_limit, light_margin=arguments.light_margin, sensor=arguments.sensor,
                 spp=arguments.spp, seed=arguments.seed)
    if output is not None:
        settings, default = found.settings, asdict(Settings())
        apply_settings(source, {name: value for name, value in settings.items()
                                if name in ("order", "method", "transfer") or value != default.get(name)}, output)
    if arguments.json:
        print(json.dumps(found.report(), indent=2))
        return
    _say(arguments, _plan_text(found))
    if output is not None:
        _say(arguments, f"wrote {output}: mi-shlight render {shlex.quote(str(output))} -o OUT.exr")


def _plan_text(found) -> str:
    """A plan as a person reads it."""
    from .shading.settings import Settings

    default = asdict(Settings())
    chosen = {name: value for name, value in found.settings.items() if name in ("order", "transfer") or value != default.get(name)}
    asked = f"error of at most {found.max_error:.2g}" + ("" if found.time_limit is None else f" within {found.time_limit:g} s")
    parts = ", ".join(f"{name} {part:.2%}" for name, part in found.parts.items() if part >= 5e-5)
    lines = [f"shprt with {', '.join(f'{name} {value}' for name, value in chosen.items())}",
             f"  error   {found.error:.2%} (+- {found.spread:.2%}) besides the noise of pixels" + (f", of {parts}" if parts else ""),
             f"  time    {found.bake:.2f} s to bake, {found.render:.2f} s to render; {found.compile:.1f} s more to compile, once",
             "why"]
    lines += [f"  {name:<17} {text}" for name, text in found.why]
    if found.choices:
        lines.append("what else there is")
        lines += [f"  {choice['error']:8.2%} in {choice['seconds']:7.2f} s   {_choice_text(choice['settings'])}"
                  for choice in _spaced(found.choices)]
    lines += [f"not rendered: {text}" for text in found.left_out]
    if not found.met:
        lines.append(f"An {asked} cannot be had: this is the most accurate there is"
                     + ("." if found.time_limit is None else " in that time, or the fastest if nothing is."))
    return "\n".join(lines)


def _choice_text(settings: dict) -> str:
    """What tells one choice of settings from another."""
    transfer, rays = settings["transfer"], f", {settings['transfer_samples']} rays per "
    rays += "hit" if settings["transfer_domain"] == "pixel" else f"point, max_edge {settings['max_edge']:.3g}"
    counts = {"grid_resolution": settings["grid_resolution"], "bounce_samples": "interreflected" in transfer,
              "bsdf_order": "glossy" in transfer}
    return (f"{transfer}, order {settings['order']}" + rays * (not transfer.startswith("unshadowed"))
            + "".join(f", {name} {settings[name]}" for name, used in counts.items() if used))


def _spaced(choices, ratio: float = 2.0) -> list:
    """Of choices from cheap to accurate those whose errors differ by a factor or more."""
    shown = []
    for choice in choices:
        if not shown or choice["error"] * ratio <= shown[-1]["error"]:
            shown.append(choice)
    return shown


def _compare(arguments) -> None:
    from .compare import compare
    from .panel import require_matplotlib, times_text
    from .rendering import sh_integrator

    require_matplotlib()
    folder = _results_folder("compare", arguments.output)
    scene = _load(arguments)
    integrator = sh_integrator(scene, _overrides(arguments))
    _announce(arguments, scene, integrator)
    folder.mkdir(exist_ok=True)
    try:
        report = compare(scene, folder, integrator=integrator, spp=arguments.spp, reference_spp=arguments.reference_spp,
                         sensor=arguments.sensor, seed=arguments.seed, title=Path(arguments.scene).name,
                         metadata=_metadata(arguments),
                         progress=lambda label, done, total: _progress(arguments, label)(done, total))
    except BaseException:
        _remove_empty(folder)
        raise
    errors, noise = report["errors"], report["noise"]
    _say(arguments, f"{report['scene']} against {report['reference']}:\n"
         f"  mean relative error  {errors['mean_relative']:8.2%}   (noise of the reference {noise['mean_relative']:.2%})\n"
         f"  bias                 {errors['bias']:+8.2%}\n"
         f"  RMSE                 {errors['rmse']:8.4f}   (noise of the reference {noise['rmse']:.4f})\n"
         f"  95 % of pixels within{errors['p95']:8.2%}   of the mean, 99 % within {errors['p99']:.2%}, all within {errors['max']:.2%}\n"
         f"  {times_text(report['times'], report['spp'])}\n"
         f"wrote sh.exr, reference.exr, panel.png, report.json to {folder}")


def _results_folder(command, name) -> Path:
    """The folder for results, which is made later if it is missing; raises if that would fail."""
    folder = Path(name)
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(message(command, "-o", "name a folder", name, "A file of that name exists."))
    check_output(command, "-o", folder / "file" if folder.is_dir() else folder)
    return folder


def _remove_empty(folder) -> None:
    if not any(folder.iterdir()):
        folder.rmdir()


def _info(arguments) -> None:
    from importlib.metadata import version

    import mitsuba

    from .llvm import llvm_info, require_llvm

    try:
        require_llvm()
        found = llvm_info()
        llvm = f"{'.'.join(map(str, found['version']))} ({found['path']})"
    except (RuntimeError, ImportError, OSError) as error:
        llvm = f"not usable: {paragraph(error)}"
    lines = {"mi_shlight": mi_shlight.__version__, "mitsuba": version("mitsuba"), "drjit": version("drjit"),
             "numpy": version("numpy"), "OpenEXR": version("OpenEXR"), "Python": sys.version.split()[0], "LLVM": llvm,
             "CUDA": "usable" if _has_cuda() else "not usable", "variants": ", ".join(mitsuba.variants()),
             "default": DEFAULT_VARIANT, "cores": str(os.cpu_count())}
    for name, text in lines.items():
        print(f"{name:<11}{text}")


# ---- loading


def _load(arguments):
    """Activate the variant and load the scene file."""
    path = Path(arguments.scene)
    if not path.is_file():
        raise FileNotFoundError(message(arguments.command, "SCENE", "name an existing Mitsuba XML file", arguments.scene,
                                        "Check the path." if not path.is_dir() else "It is a folder."))
    import mitsuba as mi

    usable = [name for name in mi.variants() if not name.startswith("scalar")]
    if not _has_cuda():
        usable = [name for name in usable if not name.startswith("cuda")]
    if arguments.variant not in usable:
        raise ValueError(message(arguments.command, "--variant", "be a JIT variant of Mitsuba that runs here", arguments.variant,
                                 f"Choose one of: {', '.join(usable)}."))
    if arguments.variant.startswith("llvm"):
        from .llvm import require_llvm
        require_llvm()
    mi.set_variant(arguments.variant)  # also registers the plugins, as mi_shlight is imported
    try:
        # Mitsuba's merging of meshes would make the order of shapes, and so the noise of an image, differ between runs.
        scene = mi.load_file(str(path), optimize=False, **dict(arguments.define))
    except RuntimeError as error:
        text = paragraph(error)
        raise RuntimeError(f"{text}{'' if text.endswith(('.', '!', '?')) else '.'} {_loading_hint(str(error), path)}") from None
    if not isinstance(scene, mi.Scene):
        raise ValueError(message(arguments.command, "SCENE", "have a <scene> at its top", arguments.scene,
                                 f"It describes a {type(scene).__name__}."))
    return scene


def _loading_hint(text, path) -> str:
    """What to do about a message of Mitsuba's parser."""
    if "unused parameters" in text:
        names = re.findall(r"<default\s+name\s*=\s*[\"']([^\"']+)", path.read_text(errors="replace"))
        declared = f"it declares {', '.join(names)}" if names else "it declares none"
        return f"-D sets a value that the scene uses as $name; {declared}."
    if "unreferenced propert" in text:
        return "Correct the name or remove it; each plugin's manual page lists its parameters."
    return f"Correct '{path.name}', or the value given to it by -D, and try again."


def _has_cuda() -> bool:
    import drjit

    return drjit.has_backend(drjit.JitBackend.CUDA)


def _overrides(arguments) -> dict:
    """The `shprt` parameters given as options."""
    return {name: value for name in SHPRT_OPTIONS if (value := getattr(arguments, name, None)) is not None}


def _metadata(arguments) -> dict:
    import drjit
    import mitsuba

    return {"scene": Path(arguments.scene).name, "integrator": "shprt", "variant": arguments.variant,
            "mi_shlight": mi_shlight.__version__, "mitsuba": mitsuba.__version__, "drjit": drjit.__version__}


# ---- speaking to the user


def _say(arguments, text) -> None:
    if not arguments.quiet:
        print(text, flush=True)


def _announce(arguments, scene, integrator) -> None:
    settings = integrator.parameters()
    source = "" if isinstance(scene.integrator(), type(integrator)) else " (the scene names another integrator)"
    _say(arguments, f"shprt, order {settings['order']}, method {settings['method']}, transfer {settings['transfer']} per "
         f"{settings['transfer_domain']}{source}")


def _progress(arguments, label):
    """A function (done, total) that draws a bar on stderr if that is a terminal and --quiet is not given."""
    visible = sys.stderr.isatty() and not arguments.quiet

    def draw(done, total):
        if not visible:
            return
        filled = 30 * done // max(total, 1)
        end = "\n" if done >= total else ""
        print(f"\r{label:<16} [{'#' * filled}{'.' * (30 - filled)}] {done / max(total, 1):4.0%}", end=end, file=sys.stderr, flush=True)

    return draw


@contextmanager
def _one_line_warnings():
    """Print each distinct warning of this package once, as one line without its place in the code."""
    with warnings.catch_warnings():
        warnings.simplefilter("once", SHLightWarning)
        usual = warnings.showwarning

        def show(text, category, *place, **options):
            if issubclass(category, SHLightWarning):
                print(f"mi-shlight: warning: {paragraph(text)}", file=sys.stderr, flush=True)
            else:
                usual(text, category, *place, **options)

        warnings.showwarning = show
        yield


def root_cause(error: BaseException) -> BaseException:
    """The exception inside those that Dr.Jit and Mitsuba wrap around it, which only say "see above"."""
    while error.__cause__ is not None and "(see above)" in str(error):
        error = error.__cause__
    return error


def paragraph(error) -> str:
    """The text of an error on one line, without Mitsuba's source positions and the tracebacks it embeds; locations stay."""
    text = str(error) or type(error).__name__
    text = re.sub(r"\[\w+\.(cpp|h):\d+\] ", "", text)
    text = re.sub(r"Traceback \(most recent call last\):\n(?:[ \t]+.*\n)*", "", text)
    text = re.sub(r"At dictionary node \"\w*\": failed to instantiate [^:]*: (?=\S)", "", text)
    text = re.sub(r"(^|: )(?:[\w.]*\.)?\w+(?:Error|Exception): ", r"\1", text, count=1)
    return re.sub(r"\s+", " ", text).strip()


# ---- arguments


class _Parser(argparse.ArgumentParser):
    """Reports a usage error as any other error, in one paragraph."""

    def error(self, message):
        raise ValueError(f"{message}. See '{self.prog} --help'.")


def _number(text):
    """An integer or a float as written; the library checks types and ranges, so both reach it unchanged."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    raise argparse.ArgumentTypeError(f"must be a number, got '{text}'")


def _number_or_auto(text):
    return text if text == "auto" else _number(text)


def _share(text):
    """A number, or one followed by a per cent sign."""
    return _number(text[:-1]) / 100 if text.endswith("%") else _number(text)


def _define(text):
    name, separator, value = text.partition("=")
    if not separator or not name:
        raise argparse.ArgumentTypeError(f"must have the form name=value, got '{text}'")
    if name in LOADER_ARGUMENTS:
        raise argparse.ArgumentTypeError(f"must name a value of the scene file, got '{name}', which Mitsuba's loader reserves; "
                                         "use another name in the scene file")
    return name, value


# Parameters of `shprt` that an option can set, with the option's argument parser entries.
SHPRT_OPTIONS = {
    "order": dict(type=_number, metavar="N", help="highest spherical-harmonic degree"),
    "method": dict(metavar="M", help="how lights are projected: auto, recurrence, edge, quadrature"),
    "transfer": dict(metavar="K", help="unshadowed, shadowed or exact, plus interreflected, plus glossy, such as exact+glossy"),
    "transfer_domain": dict(metavar="D", help="vertex (baked) or pixel (rays at each hit)"),
    "transfer_samples": dict(type=_number, metavar="N", help="rays per vertex or per pixel hit; 0: the default"),
    "transfer_file": dict(metavar="FILE", help="use a transfer made by 'mi-shlight bake'"),
    "max_edge": dict(type=_number, metavar="X", help="longest triangle edge of the bake, in scene units; 0: automatic"),
    "light_margin": dict(type=_number, metavar="X", help="how far lights may move after the bake, in scene units"),
    "localised": dict(action=argparse.BooleanOptionalAction, default=None, help="fit transfer where near lights can be (the default)"),
    "window": dict(metavar="W", help="against ringing of transfer that is not localised: none, hann, lanczos, gauss"),
    "bounces": dict(type=_number, metavar="N", help="reflections between surfaces; 0: until bounce-tolerance"),
    "bounce_tolerance": dict(type=_number, metavar="X", help="share that the next reflection may add"),
    "bounce_samples": dict(type=_number, metavar="N", help="rays per vertex that look for light from other surfaces"),
    "bounce_lighting": dict(metavar="L", help="gather (lights light the surfaces themselves) or transfer (as if lights were distant)"),
    "visibility_order": dict(type=_number, metavar="N", help="degree of visibility for glossy reflection"),
    "bsdf_order": dict(type=_number, metavar="N", help="degree of BSDFs for glossy reflection"),
    "grid_resolution": dict(type=_number_or_auto, metavar="M", help="points of the light grid along an axis; 0: none; or auto"),
    "grid_interpolation": dict(metavar="I", help="hermite, tricubic, trilinear, taylor, inverse_distance"),
    "grid_error": dict(type=_number, metavar="X", help="relative error up to which lights go through the grid; 0: all do"),
    "strict": dict(action="store_true", default=None, help="refuse a scene of which something must be left out"),
    "coefficients": dict(action="store_true", default=None, help="add the light's coefficients as layers L.l.m"),
    "errors": dict(action="store_true", default=None, help="add what each pixel may be off by as layers, truncation_bound to total_error"),
}


MOTION_HELP = """\
A motion file holds, for instance,

  {"loop": true, "motions": [
    {"move": "light-*", "axis": [0, 1, 0], "about": [0, 0, 0], "stagger": 0.25,
     "keyframes": [{"time": 0, "rotate": 0}, {"time": 1, "rotate": 360}]},
    {"set": "light-*.emitter.radiance.value", "interpolation": "smooth",
     "keyframes": [{"time": 0, "factor": 1}, {"time": 0.5, "factor": 0.2}, {"time": 1, "factor": 1}]}]}

move    shapes or sensors (id in the scene file), by keyframes of translate [x, y, z], rotate in degrees about "axis",
        and scale; "about": [x, y, z] or "centre", the default
set     parameters as mi.traverse names them, by keyframes of value, or of factor on what the scene has
time    fraction of the animation, 0 to 1; "loop": the last frame leads to the first
"interpolation": "linear" or "smooth". Names may be patterns; "stagger" lets each match run that much ahead of the one
before. All of it: python -m pydoc mi_shlight.motion

All frames have the same seed, so that what does not move does not flicker, and the same exposure.
"""


def _parser() -> _Parser:
    parser = _Parser(prog="mi-shlight", allow_abbrev=False,
                     description="Light Mitsuba scenes by polygonal area lights in analytic spherical harmonics.")
    parser.add_argument("--version", action="version", version=f"mi-shlight {mi_shlight.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    render = commands.add_parser("render", allow_abbrev=False, help="render a scene with shprt to an EXR file",
                                 description="Render a scene with shprt. Parameters come from the scene's own shprt "
                                 "integrator, or are the defaults; options override them.")
    _add_scene(render, "OUT.exr", "image to write")
    _add_camera(render)
    render.add_argument("--spp", type=_number, default=0, metavar="N", help="samples per pixel; default: the scene's")
    _add_shprt(render, SHPRT_OPTIONS)
    render.set_defaults(run=_render)

    animate = commands.add_parser("animate", allow_abbrev=False, help="render the frames of a scene in motion",
                                  description="Render a scene while lights, or anything else, move: frame_0000.png and so on, and a "
                                  "video where ffmpeg is installed. Parameters are those of render.", epilog=MOTION_HELP,
                                  formatter_class=argparse.RawDescriptionHelpFormatter)
    _add_scene(animate, "DIR", "folder for the frames; made if missing")
    animate.add_argument("--frames", required=True, type=_number, metavar="N", help="number of frames")
    animate.add_argument("--motion", required=True, metavar="FILE", help="what moves: JSON text, see below")
    animate.add_argument("--fps", type=_number, default=24, metavar="X", help="frames per second of the video (%(default)s)")
    animate.add_argument("--exposure", type=_number, default=1, metavar="X", help="factor on the colours of the frames (%(default)s)")
    _add_camera(animate)
    animate.add_argument("--spp", type=_number, default=0, metavar="N", help="samples per pixel of a frame; default: the scene's")
    _add_shprt(animate, [name for name in SHPRT_OPTIONS if name not in ("coefficients", "errors")])
    animate.set_defaults(run=_animate)

    bake = commands.add_parser("bake", allow_abbrev=False, help="precompute a scene's transfer",
                               description="Bake the transfer of a scene's vertices for --transfer-file: shadowed or exact. What "
                               "interreflected and glossy need besides is traced at the first render.")
    _add_scene(bake, "FILE", "transfer file to write")
    bake.add_argument("--samples", dest="transfer_samples", type=_number, metavar="N", help="rays per vertex; default: 1024")
    _add_shprt(bake, ("order", "transfer", "localised", "max_edge", "light_margin"))
    bake.set_defaults(run=_bake)

    plan = commands.add_parser("plan", allow_abbrev=False, help="find the cheapest settings for an error",
                               description="Look at a scene, in seconds, and find the cheapest settings of shprt whose mean relative "
                               "error, as compare has it, is what you ask for; with the expected error and time, and why.")
    _add_scene(plan)
    plan.add_argument("--max-error", required=True, type=_share, metavar="E", help="largest mean error besides pixel noise, such as 1%%")
    plan.add_argument("--time-limit", type=_number, metavar="T",
                      help="seconds for bake and picture; then the least error in that time if E takes longer")
    plan.add_argument("--light-margin", type=_number, metavar="X", help="how far lights will move, in scene units; default: the scene's")
    plan.add_argument("--spp", type=_number, default=0, metavar="N", help="samples per pixel to count with; default: the scene's")
    plan.add_argument("--apply", nargs="?", const="", metavar="FILE", help="write the scene with these settings; default name: "
                      "SCENE_planned.xml")
    plan.add_argument("--json", action="store_true", help="print the plan as JSON")
    _add_camera(plan)
    plan.set_defaults(run=_plan)

    compare = commands.add_parser("compare", allow_abbrev=False, help="render with shprt and with path tracing",
                                  description="Render a scene with shprt and with path (direct illumination, or as many bounces as shprt); "
                                  "write both EXR files, a panel of pictures and a report of errors and times.")
    _add_scene(compare, "DIR", "folder for the results; made if missing")
    _add_camera(compare)
    compare.add_argument("--spp", type=_number, default=16, metavar="N", help="samples per pixel of the SH image (%(default)s)")
    compare.add_argument("--reference-spp", type=_number, default=1024, metavar="N",
                         help="samples per pixel of the path-traced reference (%(default)s)")
    _add_shprt(compare, SHPRT_OPTIONS)
    compare.set_defaults(run=_compare)

    info = commands.add_parser("info", allow_abbrev=False, help="versions, LLVM, variants",
                               description="Print the versions in use, the LLVM library found, and Mitsuba's variants.")
    info.add_argument("--traceback", action="store_true", help="show the Python traceback of an error")
    info.set_defaults(run=_info)
    return parser


def _add_scene(parser, output: str = "", help_output: str = "") -> None:
    parser.add_argument("scene", metavar="SCENE", help="Mitsuba XML file")
    if output:
        parser.add_argument("-o", "--output", required=True, metavar=output, help=help_output)
    parser.add_argument("-D", "--define", action="append", default=[], type=_define, metavar="NAME=VALUE",
                        help="set $NAME of the scene file; may be repeated")
    parser.add_argument("-m", "--variant", default=DEFAULT_VARIANT, metavar="V", help="Mitsuba variant (%(default)s)")
    parser.add_argument("-q", "--quiet", action="store_true", help="print errors and warnings only")
    parser.add_argument("--traceback", action="store_true", help="show the Python traceback of an error")


def _add_camera(parser) -> None:
    parser.add_argument("-s", "--sensor", type=_number, default=0, metavar="I", help="index of the sensor (%(default)s)")
    parser.add_argument("--seed", type=_number, default=0, metavar="N", help="seed of the random numbers (%(default)s)")


def _add_shprt(parser, names) -> None:
    for name in names:
        parser.add_argument("--" + name.replace("_", "-"), dest=name, **SHPRT_OPTIONS[name])
