"""Writes the example scenes of this folder: ``python scenes/generate.py [DIRECTORY]``.

The same bytes come out on every run and machine: the only randomness is the seeded ``random.random()``, whose
sequence Python guarantees, and coordinates are rounded to 1e-5 so that the last bit of a sine cannot show.
Meshes and textures come from ``generate_meshes.py``. y is up, lengths are in scene units.
"""
from __future__ import annotations

import sys
import textwrap
from pathlib import Path

import numpy as np
from generate_meshes import (PLINTH_HALF_WIDTH, PLINTH_TURN, TRIANGLE, blue_waves, bottle, cove, cushion, disc, flat_light, panel, pillar,
                             pink_rings, plant, pot, rotation, sculpture, transform, write_ply, write_png)

HERE = Path(__file__).resolve().parent


# ------------------------------------------------------------------------------------------------ scene files
def xml_defaults(spp: int, width: int, height: int) -> str:
    values = {"spp": spp, "resx": width, "resy": height, "order": 8}
    return "\n".join(f'    <default name="{name}" value="{value}"/>' for name, value in values.items())


INTEGRATOR = """\
    <integrator type="shprt">
        <integer name="order" value="$order"/>
    </integrator>"""

INTEGRATOR_WITH_GRID = """\
    <integrator type="shprt">
        <integer name="order" value="$order"/>
        <string name="grid_resolution" value="auto"/>
    </integrator>"""

INTEGRATOR_BY_PIXEL = """\
    <integrator type="shprt">
        <integer name="order" value="$order"/>
        <string name="method" value="edge"/>
        <string name="transfer_domain" value="pixel"/>
        <integer name="transfer_samples" value="32"/>
    </integrator>"""


def xml_sensor(origin, target, fov: float, extra: str = "", rfilter: str = "gaussian",
               sampler: str = "independent") -> str:
    origin, target = (", ".join(f"{c:g}" for c in point) for point in (origin, target))
    return f"""\
    <sensor type="perspective" id="sensor">
        <string name="fov_axis" value="smaller"/>
        <float name="fov" value="{fov:g}"/>{extra}
        <transform name="to_world">
            <lookat origin="{origin}" target="{target}" up="0, 1, 0"/>
        </transform>
        <sampler type="{sampler}">
            <integer name="sample_count" value="$spp"/>
        </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$resx"/>
            <integer name="height" value="$resy"/>
            <string name="pixel_format" value="rgb"/>
            <string name="component_format" value="float32"/>
            <rfilter type="{rfilter}"/>
        </film>
    </sensor>"""


def xml_diffuse(name: str, reflectance, two_sided: bool = False) -> str:
    inner = f'<rgb name="reflectance" value="{", ".join(map(str, reflectance))}"/>'
    if two_sided:
        return f"""\
    <bsdf type="twosided" id="{name}">
        <bsdf type="diffuse">
            {inner}
        </bsdf>
    </bsdf>"""
    return f"""\
    <bsdf type="diffuse" id="{name}">
        {inner}
    </bsdf>"""


def xml_checkerboard(name: str, dark, light, repeats: float) -> str:
    dark, light = (", ".join(map(str, c)) for c in (dark, light))
    return f"""\
    <bsdf type="diffuse" id="{name}">
        <texture name="reflectance" type="checkerboard">
            <rgb name="color0" value="{dark}"/>
            <rgb name="color1" value="{light}"/>
            <transform name="to_uv">
                <scale x="{repeats:g}" y="{repeats:g}"/>
            </transform>
        </texture>
    </bsdf>"""


def xml_radiance(radiance, extra: str = "") -> str:
    return f"""
        <emitter type="shlight">
            <rgb name="radiance" value="{", ".join(map(str, radiance))}"/>{extra}
        </emitter>"""


def xml_textured(texture: str, subdivisions: int) -> str:
    return f"""
        <emitter type="shlight">
            <texture name="radiance" type="bitmap">
                <string name="filename" value="meshes/{texture}.png"/>
            </texture>
            <integer name="subdivisions" value="{subdivisions}"/>
        </emitter>"""


TWO_SIDED = """
            <boolean name="two_sided" value="true"/>"""


def xml_shape(name: str, kind: str, operations: tuple[str, ...], bsdf: str = "", radiance=None, emitter: str = "", file: str = "") -> str:
    """A built-in shape or a mesh file; `operations` are the elements of its to_world transform, first applied first."""
    steps = "\n".join(f"            {op}" for op in operations)
    body = f"""
        <transform name="to_world">
{steps}
        </transform>"""
    if file:
        body = f'\n        <string name="filename" value="meshes/{file}.ply"/>' + body
    if bsdf:
        body += f'\n        <ref id="{bsdf}"/>'
    if radiance is not None:
        emitter = xml_radiance(radiance)
    return f"""\
    <shape type="{kind}" id="{name}">{body}{emitter}
    </shape>"""


def xml_mesh(name: str, file: str, bsdf: str = "", radiance=None) -> str:
    """A mesh file; a light is flat-shaded so that its normals are exactly those of its plane."""
    body = f'\n        <string name="filename" value="meshes/{file}.ply"/>'
    if bsdf:
        body += f'\n        <ref id="{bsdf}"/>'
    if radiance is not None:
        body += '\n        <boolean name="face_normals" value="true"/>' + xml_radiance(radiance)
    return f"""\
    <shape type="ply" id="{name}">{body}
    </shape>"""


def xml_triangle(name: str, matrix: np.ndarray, radiance: np.ndarray) -> str:
    """A light of `many_lights`, on few lines."""
    number = lambda v: f"{round(float(v), 3) + 0.0:g}"
    values = " ".join(number(v) for v in matrix.ravel()) + " 0 0 0 1"
    return f"""\
<shape type="ply" id="{name}"><string name="filename" value="meshes/triangle.ply"/><boolean name="face_normals" value="true"/>
<transform name="to_world"><matrix value="{values}"/></transform>
<emitter type="shlight"><rgb name="radiance" value="{" ".join(number(c) for c in radiance)}"/></emitter></shape>"""


def xml_scene(comment: str, *parts: str) -> str:
    note = textwrap.fill(comment, 110, initial_indent="    <!-- ", subsequent_indent="         ")
    return f'<scene version="3.0.0">\n{note} -->\n' + "\n\n".join(parts) + "\n</scene>\n"


def cornell_box() -> str:
    return xml_scene(
        "Purpose: Mitsuba's own Cornell box (mi.cornell_box()), its ceiling light a shlight. Picture: red wall left, "
        "green wall right, two white boxes with soft shadows away from the light above them; the ceiling is black "
        "because the lighting is direct.",
        xml_defaults(64, 256, 256), INTEGRATOR,
        xml_sensor((0, 0, 3.9), (0, 0, 0), 39.3077, extra="""
        <float name="near_clip" value="0.001"/>
        <float name="far_clip" value="100"/>
        <float name="focus_distance" value="1000"/>"""),
        xml_diffuse("white", (0.885809, 0.698859, 0.666422)),
        xml_diffuse("green", (0.105421, 0.37798, 0.076425)),
        xml_diffuse("red", (0.570068, 0.0430135, 0.0443706)),
        xml_shape("light", "rectangle", ('<scale x="0.23" y="0.19" z="0.19"/>', '<rotate x="1" angle="90"/>',
                                         '<translate y="0.99" z="0.01"/>'), "white", (18.387, 13.9873, 6.75357)),
        xml_shape("floor", "rectangle", ('<rotate x="1" angle="-90"/>', '<translate y="-1"/>'), "white"),
        xml_shape("ceiling", "rectangle", ('<rotate x="1" angle="90"/>', '<translate y="1"/>'), "white"),
        xml_shape("back", "rectangle", ('<translate z="-1"/>',), "white"),
        xml_shape("green-wall", "rectangle", ('<rotate y="1" angle="-90"/>', '<translate x="1"/>'), "green"),
        xml_shape("red-wall", "rectangle", ('<rotate y="1" angle="90"/>', '<translate x="-1"/>'), "red"),
        xml_shape("small-box", "cube", ('<scale value="0.3"/>', '<rotate y="1" angle="-17"/>',
                                        '<translate x="0.335" y="-0.7" z="0.38"/>'), "white"),
        xml_shape("large-box", "cube", ('<scale x="0.3" y="0.61" z="0.3"/>', '<rotate y="1" angle="18.25"/>',
                                        '<translate x="-0.33" y="-0.4" z="-0.28"/>'), "white"))


def floor_scene() -> str:
    return xml_scene(
        "Purpose: accuracy without visibility: one rectangle light over an unoccluded diffuse floor that fills the "
        "view. Picture: a smooth grey glow, brightest in the middle, no edge and no background.",
        xml_defaults(64, 128, 128), INTEGRATOR,
        xml_sensor((0, 5, 3), (0, 0, 0), 26),
        xml_diffuse("grey", (0.6, 0.6, 0.6)),
        xml_shape("floor", "rectangle", ('<scale value="4"/>', '<rotate x="1" angle="-90"/>'), "grey"),
        xml_shape("light", "rectangle", ('<scale x="0.7" y="0.5"/>', '<rotate x="1" angle="90"/>',
                                         '<translate x="0.3" y="2.5" z="-0.2"/>'), radiance=(9.0, 8.5, 8.0)))


def plant_scene() -> str:
    return xml_scene(
        "Purpose: many thin two-sided leaves, lit by a near triangle (warm, from the left) and a farther rectangle "
        "(cool, from the right). Picture: a potted plant on a chequered floor before a wall, with a soft shadow of "
        "each light on floor and wall; both lights are out of view.",
        xml_defaults(64, 256, 256), INTEGRATOR,
        xml_sensor((0.1, 1.6, 4.6), (0, 0.9, -0.3), 25),
        xml_checkerboard("tiles", (0.30, 0.27, 0.25), (0.62, 0.60, 0.56), 8),
        xml_diffuse("plaster", (0.66, 0.65, 0.62)),
        xml_diffuse("terracotta", (0.60, 0.29, 0.18), two_sided=True),
        xml_diffuse("earth", (0.16, 0.11, 0.08)),
        xml_diffuse("bark", (0.34, 0.36, 0.16)),
        xml_diffuse("foliage", (0.20, 0.50, 0.13), two_sided=True),
        xml_shape("floor", "rectangle", ('<scale value="2.6"/>', '<rotate x="1" angle="-90"/>',
                                         '<translate z="1.7"/>'), "tiles"),
        xml_shape("wall", "rectangle", ('<scale x="2.6" y="1.6"/>', '<translate y="1.6" z="-0.9"/>'), "plaster"),
        xml_mesh("pot", "plant_pot", "terracotta"),
        xml_mesh("soil", "plant_soil", "earth"),
        xml_mesh("stem", "plant_stem", "bark"),
        xml_mesh("leaves", "plant_leaves", "foliage"),
        xml_mesh("light-triangle", "plant_light_triangle", radiance=(58.0, 45.0, 31.0)),
        xml_shape("light-rectangle", "rectangle", ('<scale x="0.8" y="0.6"/>', '<lookat origin="3.4, 2.7, 2.6" '
                                                   'target="0, 0.7, 0" up="0, 1, 0"/>'), radiance=(9.0, 11.0, 15.0)))


def sculpture_scene() -> str:
    return xml_scene(
        "Purpose: a smooth closed body under three polygon shapes: a rectangle (white, far left), a triangle (warm, "
        "near right) and a concave arrow (blue, from above and behind). Picture: a knotted sculpture on a plinth in a "
        "studio cove, with three overlapping soft shadows; all lights are out of view.",
        xml_defaults(64, 256, 256), INTEGRATOR,
        xml_sensor((0, 2.3, 6.6), (0, 1.35, 0), 31),
        xml_diffuse("paper", (0.70, 0.70, 0.70)),
        xml_checkerboard("inlay", (0.30, 0.29, 0.30), (0.5, 0.49, 0.48), 3),
        xml_diffuse("plaster", (0.80, 0.76, 0.70)),
        xml_mesh("cove", "sculpture_cove", "paper"),
        xml_shape("plinth", "cube", (f'<scale x="{PLINTH_HALF_WIDTH}" y="0.3" z="{PLINTH_HALF_WIDTH}"/>',
                                     f'<rotate y="1" angle="{PLINTH_TURN}"/>', '<translate y="0.3"/>'), "inlay"),
        xml_mesh("knot", "sculpture_knot", "plaster"),
        xml_shape("light-rectangle", "rectangle", ('<scale x="0.9" y="0.9"/>', '<lookat origin="-3.4, 4.4, 3.6" '
                                                   'target="0, 1.4, 0" up="0, 1, 0"/>'), radiance=(30.0, 29.0, 27.0)),
        xml_mesh("light-triangle", "sculpture_light_triangle", radiance=(20.0, 13.0, 7.0)),
        xml_mesh("light-arrow", "sculpture_light_arrow", radiance=(16.0, 23.0, 37.0)))


def inverse_room() -> str:
    return xml_scene(
        "Purpose: recover the light from the picture (inverse_rendering.py): blockers at several heights, so that penumbras of "
        "several widths fall on floor and walls, and a light out of view with room to move. Visibility is traced anew at "
        "every pixel, as the light moves. Picture: a column, a floating slab and a box in the corner of a room, lit from the left.",
        xml_defaults(4, 64, 64), INTEGRATOR_BY_PIXEL,
        xml_sensor((0.7, 3.3, 4.3), (0.1, 0.25, -0.2), 32, rfilter="box", sampler="multijitter"),
        xml_diffuse("plaster", (0.70, 0.70, 0.70)),
        xml_diffuse("sand", (0.65, 0.65, 0.60)),
        xml_diffuse("sky", (0.60, 0.65, 0.70)),
        xml_diffuse("clay", (0.70, 0.55, 0.50)),
        xml_diffuse("straw", (0.70, 0.70, 0.55)),
        xml_diffuse("slate", (0.50, 0.60, 0.70)),
        xml_shape("floor", "rectangle", ('<scale value="2.2"/>', '<rotate x="1" angle="-90"/>'), "plaster"),
        xml_shape("back", "rectangle", ('<scale x="2.2"/>', '<translate y="1" z="-1.4"/>'), "sand"),
        xml_shape("side", "rectangle", ('<scale x="2.2"/>', '<rotate y="1" angle="-90"/>', '<translate x="1.5" y="1"/>'), "sky"),
        xml_shape("column", "cube", ('<scale x="0.2" y="0.45" z="0.2"/>', '<rotate y="1" angle="20"/>',
                                     '<translate x="-0.5" y="0.45" z="-0.2"/>'), "clay"),
        xml_shape("slab", "cube", ('<scale x="0.45" y="0.03" z="0.3"/>', '<rotate y="1" angle="10"/>',
                                   '<translate x="0.25" y="0.75" z="-0.5"/>'), "straw"),
        xml_shape("box", "cube", ('<scale x="0.25" y="0.2" z="0.25"/>', '<rotate y="1" angle="-30"/>',
                                  '<translate x="0.4" y="0.2" z="0.35"/>'), "slate"),
        xml_shape("light", "rectangle", ('<scale x="0.7" y="0.4"/>', '<lookat origin="-1.5, 1.9, 0.7" target="0, 0.3, 0" '
                                         'up="0, 1, 0"/>'), radiance=(12.0, 10.0, 7.0)))


def textured_room() -> str:
    def cushioned(name, size, place, bsdf, turn=0.0):
        scale = " ".join(f'{axis}="{value}"' for axis, value in zip("xyz", size))
        move = " ".join(f'{axis}="{value}"' for axis, value in zip("xyz", place))
        steps = f"<scale {scale}/>", f'<rotate x="1" angle="{turn:g}"/>', f"<translate {move}/>"
        return xml_shape(name, "ply", steps, bsdf, file="cushion")

    return xml_scene(
        "Purpose: two textured lights, cut into 168 and 176 uniform triangles: 344, as in Fig. 10 of Wu et al. 2020. Picture: a living "
        "room with sofa, table and vase; a screen with blue waves on the left wall, one with pink rings on the right, whose colours mix "
        "on floor and cushions.",
        xml_defaults(64, 256, 256), INTEGRATOR_WITH_GRID,
        xml_sensor((0.0, 1.2, 3.75), (0, 0.74, -0.3), 40),
        xml_diffuse("plaster", (0.80, 0.79, 0.77)),
        xml_checkerboard("parquet", (0.52, 0.44, 0.36), (0.70, 0.62, 0.53), 10),
        xml_diffuse("linen", (0.78, 0.77, 0.75)),
        xml_diffuse("felt", (0.62, 0.63, 0.66)),
        xml_diffuse("oak", (0.64, 0.54, 0.43)),
        xml_diffuse("glaze", (0.80, 0.80, 0.78), two_sided=True),
        xml_shape("floor", "rectangle", ('<scale x="1.5" y="1.5"/>', '<rotate x="1" angle="-90"/>', '<translate z="0.25"/>'), "parquet"),
        xml_shape("back", "rectangle", ('<scale x="1.5" y="1.1"/>', '<translate y="1.1" z="-1.25"/>'), "plaster"),
        xml_shape("left", "rectangle", ('<scale x="1.5" y="1.1"/>', '<rotate y="1" angle="90"/>',
                                        '<translate x="-1.5" y="1.1" z="0.25"/>'), "plaster"),
        xml_shape("right", "rectangle", ('<scale x="1.5" y="1.1"/>', '<rotate y="1" angle="-90"/>',
                                         '<translate x="1.5" y="1.1" z="0.25"/>'), "plaster"),
        cushioned("sofa-base", (0.80, 0.13, 0.36), (0, 0.18, -0.72), "felt"),
        cushioned("seat-left", (0.37, 0.10, 0.34), (-0.37, 0.38, -0.66), "linen"),
        cushioned("seat-right", (0.37, 0.10, 0.34), (0.37, 0.38, -0.66), "linen"),
        cushioned("rest-left", (0.37, 0.27, 0.11), (-0.37, 0.70, -0.93), "linen", -14),
        cushioned("rest-right", (0.37, 0.27, 0.11), (0.37, 0.70, -0.93), "linen", -14),
        cushioned("arm-left", (0.12, 0.28, 0.39), (-0.88, 0.33, -0.70), "felt"),
        cushioned("arm-right", (0.12, 0.28, 0.39), (0.88, 0.33, -0.70), "felt"),
        xml_shape("table-top", "cube", ('<scale x="0.42" y="0.025" z="0.27"/>', '<translate y="0.35" z="0.3"/>'), "oak"),
        *(xml_shape(f"table-leg-{k}", "cube", ('<scale x="0.025" y="0.1625" z="0.025"/>', f'<translate x="{x}" y="0.1625" z="{z}"/>'),
                    "oak") for k, (x, z) in enumerate([(-0.35, 0.1), (0.35, 0.1), (-0.35, 0.5), (0.35, 0.5)])),
        xml_shape("vase", "ply", ('<scale value="0.36"/>', '<translate x="0.2" y="0.375" z="0.25"/>'), "glaze", file="bottle"),
        xml_shape("light-blue", "rectangle", ('<scale x="1.2" y="0.7"/>', '<rotate y="1" angle="90"/>',
                                              '<translate x="-1.48" y="0.95" z="0.15"/>'), emitter=xml_textured("blue_waves", 168)),
        xml_shape("light-pink", "rectangle", ('<scale x="1.1" y="0.8"/>', '<rotate y="1" angle="-90"/>',
                                              '<translate x="1.48" y="0.95" z="0.15"/>'), emitter=xml_textured("pink_rings", 176)))


def many_lights() -> str:
    panels = [panel((-3.4, 2.7, 2.2), (0, 0.6, 0), 2.4, [(9, 1.2, 0.6), (9, 5, 0.8), (8, 1, 3), (9, 8, 4)]),
              panel((3.6, 2.5, 1.8), (0, 0.6, 0), 2.4, [(0.8, 2, 8), (0.6, 6, 7), (3, 2.5, 9), (2, 8, 5)]),
              panel((0.2, 4.8, -0.8), (0, 0.3, 0.1), 2.4, [(1, 5, 1.5), (5, 5, 5), (2, 1.5, 6), (6, 2.5, 5)])]
    lights = [light for part in panels for light in part]
    return xml_scene(
        "Purpose: 723 lights, each a triangle that can be moved, turned and coloured alone (light_000 to light_722), in three panels "
        "of 241: Fig. 1 of Wu et al. 2020 with diffuse surfaces. Picture: a knotted sculpture, a fluted pillar and a block on a floor, lit "
        "red to yellow from the left, blue to green from the right, and mixed from above; the lights are out of view.",
        xml_defaults(64, 256, 256), INTEGRATOR_WITH_GRID,
        xml_sensor((0, 2.3, 6.4), (0, 0.95, 0), 29),
        xml_diffuse("paper", (0.70, 0.70, 0.70)),
        xml_diffuse("plaster", (0.80, 0.79, 0.77)),
        xml_diffuse("chalk", (0.72, 0.74, 0.76)),
        xml_diffuse("slate", (0.45, 0.45, 0.47)),
        xml_shape("floor", "rectangle", ('<scale value="3.6"/>', '<rotate x="1" angle="-90"/>'), "paper"),
        xml_shape("wall", "rectangle", ('<scale x="3.6" y="1.6"/>', '<translate y="1.6" z="-2"/>'), "paper"),
        xml_shape("knot", "ply", ('<translate x="0.55" y="-0.585" z="0.1"/>',), "plaster", file="sculpture_knot"),
        xml_shape("pillar", "ply", ('<translate x="-0.95" z="-0.4"/>',), "chalk", file="pillar"),
        xml_shape("block", "cube", ('<scale x="0.2" y="0.2" z="0.2"/>', '<rotate y="1" angle="25"/>',
                                    '<translate x="-0.75" y="0.2" z="0.75"/>'), "slate"),
        "\n".join(xml_triangle(f"light_{k:03d}", *light) for k, light in enumerate(lights)))


def double_sided() -> str:
    return xml_scene(
        "Purpose: a light that emits on both sides, in the middle of what it lights: next to it and along its plane the lighting varies "
        "quickly, which a coarse grid blurs (Fig. 12 of Wu et al. 2020). Picture: a screen on edge between a knotted sculpture and "
        "a block; the floor is bright to both sides of the screen and dark along its plane.",
        xml_defaults(64, 256, 256), INTEGRATOR,
        xml_sensor((0.9, 3.9, 4.2), (0.15, 0.2, 0.05), 33),
        xml_diffuse("paper", (0.70, 0.70, 0.70)),
        xml_diffuse("plaster", (0.80, 0.76, 0.70)),
        xml_diffuse("slate", (0.45, 0.50, 0.56)),
        xml_shape("floor", "rectangle", ('<scale value="3.2"/>', '<rotate x="1" angle="-90"/>'), "paper"),
        xml_shape("knot", "ply", ('<translate y="-0.585"/>', '<scale value="0.6"/>', '<translate x="0.95" z="-0.1"/>'), "plaster",
                  file="sculpture_knot"),
        xml_shape("block", "cube", ('<scale x="0.25" y="0.35" z="0.25"/>', '<rotate y="1" angle="30"/>',
                                    '<translate x="-0.95" y="0.35" z="-0.3"/>'), "slate"),
        xml_shape("light", "rectangle", ('<scale x="0.8" y="0.48"/>', '<rotate y="1" angle="90"/>', '<translate x="-0.15" y="0.58"/>'),
                  emitter=xml_radiance((2.4, 2.25, 2.0), TWO_SIDED)))


# ------------------------------------------------------------------------------------------------ everything
ARROW = ([(0.0, -0.7), (0.6, 0.05), (0.25, 0.05), (0.25, 0.7), (-0.25, 0.7), (-0.25, 0.05), (-0.6, 0.05)],
         [(0, 1, 2), (0, 2, 5), (0, 5, 6), (2, 3, 4), (2, 4, 5)])


def generate(directory: Path = HERE) -> list[Path]:
    """Write all scenes and meshes under `directory` and return the paths written."""
    stem, leaves = plant()
    knot = transform(sculpture(), 0.62 * rotation("y", 20) @ rotation("z", 30), (0, 0, 0))
    meshes = {
        "plant_pot": pot(),
        "plant_soil": transform(disc(0.36, 0.02, 5, 56), np.eye(3), (0, 0.485, 0)),
        "plant_stem": stem,
        "plant_leaves": leaves,
        "plant_light_triangle": flat_light([(-0.45, -0.3), (0.45, -0.3), (0.0, 0.5)], [(0, 1, 2)],
                                           (-1.7, 2.1, 1.7), (0, 0.9, 0)),
        # Sunk by 0.01 into the plinth, whose top is at 0.6
        "sculpture_knot": transform(knot, np.eye(3), (0, 0.59 - knot.vertices[:, 1].min(), 0)),
        "sculpture_cove": cove(),
        "sculpture_light_triangle": flat_light([(-0.6, -0.4), (0.6, -0.4), (0.1, 0.6)], [(0, 1, 2)],
                                               (2.2, 1.9, 1.5), (0, 1.3, 0)),
        "sculpture_light_arrow": flat_light(*ARROW, (-1.7, 4.7, -0.6), (0.3, 2.1, 1.8)),
        "cushion": cushion(),
        "bottle": bottle(),
        "pillar": pillar(),
        "triangle": TRIANGLE,
    }
    scenes = {"cornell_box": cornell_box(), "floor": floor_scene(), "plant": plant_scene(),
              "sculpture": sculpture_scene(), "inverse_room": inverse_room(), "textured_room": textured_room(),
              "many_lights": many_lights(), "double_sided": double_sided()}
    (directory / "meshes").mkdir(parents=True, exist_ok=True)
    written = []
    for name, surface in meshes.items():
        written.append(directory / "meshes" / f"{name}.ply")
        write_ply(written[-1], surface)
    for name, pixels in {"blue_waves": blue_waves(), "pink_rings": pink_rings()}.items():
        written.append(directory / "meshes" / f"{name}.png")
        write_png(written[-1], pixels)
    for name, text in scenes.items():
        written.append(directory / f"{name}.xml")
        written[-1].write_bytes(text.encode())
    return written


if __name__ == "__main__":
    for path in generate(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE):
        print(f"{path.stat().st_size:8d} bytes  {path}")
