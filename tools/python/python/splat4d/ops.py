"""Single operations of the engine, as pure functions: NumPy arrays, or what has DLPack in the host's memory, in;
NumPy arrays out. They are for those who write a training loop of their own and want the engine as its backend.

Each takes the device first, and its docstring has shapes, units and errors. Rendering with gradients is
`splat4d.rasterization`, and for scenes that move `splat4d.Trainer.forward` and `backward`.
"""

from ._splat4d import adam, deform, deform_backward, loss, sort

__all__ = ["adam", "deform", "deform_backward", "loss", "sort"]
