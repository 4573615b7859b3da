"""Variant and precision fixtures. Tests run in `llvm_ad_rgb`; one that sets another variant restores it through `variant`."""
import pytest

mi = pytest.importorskip("mitsuba")
mi.set_variant("llvm_ad_rgb")

import drjit as dr  # noqa: E402


@pytest.fixture(autouse=True)
def _default_variant():
    """Each test starts and ends in llvm_ad_rgb, whatever it sets in between."""
    mi.set_variant("llvm_ad_rgb")
    yield
    mi.set_variant("llvm_ad_rgb")


class Precision:
    """A Dr.Jit precision under test: its types and its rounding unit."""

    def __init__(self, array, number, eps):
        self.Array3, self.Float, self.eps = array, number, eps

    def vector(self, v):
        return self.Array3(*(float(c) for c in v))


@pytest.fixture(params=["float32", "float64"])
def precision(request):
    """`Precision` for float32 and float64 on LLVM."""
    ad = dr.llvm.ad
    return {"float32": Precision(ad.Array3f, ad.Float, 6e-8), "float64": Precision(ad.Array3f64, ad.Float64, 1.2e-16)}[request.param]
