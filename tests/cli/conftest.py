"""A scene small enough to bake and render in a blink: two lights over a floor with a block on it."""
import pytest

SCENE = """<scene version="3.0.0">
    <default name="res" value="24"/>
    <default name="spp" value="4"/>
    <default name="order" value="3"/>
    {integrator}
    <sensor type="perspective">
        <float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="0, 4, 4" target="0, 0.4, 0" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="$res"/>
            <integer name="height" value="$res"/>
            <string name="pixel_format" value="rgb"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <shape type="rectangle">
        <transform name="to_world"><scale value="2"/><rotate x="1" angle="-90"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.6, 0.5"/></bsdf>
    </shape>
    <shape type="cube">
        <transform name="to_world"><scale value="0.3"/><translate x="-0.6" y="0.3"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf>
    </shape>
    {lights}
</scene>
"""
LIGHTS = """<shape type="rectangle">
        <transform name="to_world">
            <scale value="0.4"/><rotate x="1" angle="90"/><translate x="0.5" y="1.2" z="-0.4"/>
        </transform>
        <emitter type="{kind}"><rgb name="radiance" value="6, 5, 4"/></emitter>
    </shape>"""


@pytest.fixture
def scene_file(tmp_path):
    """Write a scene: scene_file(integrator=XML, lights=XML, kind='area') -> path."""
    def write(integrator="", lights=LIGHTS, kind="shlight"):
        path = tmp_path / "scene.xml"
        path.write_text(SCENE.format(integrator=integrator, lights=lights.format(kind=kind)))
        return path
    return write
