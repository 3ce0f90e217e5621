"""The engine: plain array code runs once with traced arrays, and what it computes becomes machine code.

graph       what is computed for one episode, each value once
array       traced arrays, with numpy's surface
passes      what is needed, in which order, and what may be skipped
llvm        machine code of this processor
program     a function of trees of arrays, traced and compiled
"""
