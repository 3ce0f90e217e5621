"""The engine: it runs plain array code once with traced arrays, and compiles what that code computes to machine code.

graph       the computation of one episode, each value once
array       traced arrays, with numpy's interface
passes      the order of the computation, and what may be skipped
llvm        machine code for this processor
program     a compiled function of pytrees of arrays
"""
