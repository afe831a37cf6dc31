"""Machine code for a kernel over a block of lanes: its jaxpr, lowered to LLVM, called from XLA as one operation."""
