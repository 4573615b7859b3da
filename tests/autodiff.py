"""Derivatives by Dr.Jit for tests that compare them with something else."""
import drjit as dr


def derivative(value, number, mode: str) -> float:
    """d value(t) / dt at t = 0 of a function of one `number`; `mode`: "forward" or "backward"."""
    t = dr.opaque(number, 0)                          # Dr.Jit 1.5 takes a literal for as wide as its first use
    dr.enable_grad(t)
    result = value(t)
    if mode == "backward":
        dr.backward(result)
    else:
        dr.forward(t)
    return dr.grad(t if mode == "backward" else result)[0]
