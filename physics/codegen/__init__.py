"""Machine code for a kernel over a block of lanes: its jaxpr, lowered to LLVM, called from XLA as one operation.

Knows nothing of physics: it is given a jaxpr and buffers. What it stands on is tested in tests/physics/codegen: the
primitives of JAX and their parameters (`lower`), the structures of XLA's foreign function interface (`ffi`).
"""
