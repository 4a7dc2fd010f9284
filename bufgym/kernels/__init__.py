"""Kernels as C: plain Python functions over arrays, each translated once for each set of kinds of its arguments.

The language is a small part of Python, and its meaning in C is Python's. Anything else is refused in a sentence that
names file and line.

- Numbers: whole ones are int64 and wrap around, others float64; ``//`` and ``%`` round down, and by 0 whole numbers
  give 0. float32 stays single until it meets another kind. ``and`` and ``or`` give True or False.
- Arrays in C order: elements, rows, ``len``, ``shape``; the last index may be a slice. A negative index counts from the
  end. Nothing tests an index, but in a checked program. Nothing is allocated.
- Records by their fields, which change the array; tuples and named tuples, which do not change.
- ``if``, ``while``, ``for`` over a range or an array, ``break``, ``continue``, ``return``; ``x is None`` is settled
  when a kernel is translated.
- Calls: other functions of this language, ``min``, ``max``, ``abs``, ``int``, ``float``, ``bool``, ``math``, and the
  ``unchecked_...`` functions of ``bufgym.jit``. No function calls itself.
"""
