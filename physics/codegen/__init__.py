"""Machine code for a kernel over a block of lanes: its jaxpr, lowered to LLVM, called from XLA as one operation.

Knows nothing of physics: its input is a jaxpr and buffers. tests/physics/codegen check what it relies on: JAX's
primitives and their parameters (`lower`), the structures of XLA's foreign function interface (`ffi`).
"""
