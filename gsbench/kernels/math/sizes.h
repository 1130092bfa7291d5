// Sizes that are fixed when the kernels are compiled. gsbench/kernels/headers.py reads these lines for Python.
#pragma once

namespace gsb {

constexpr int TILE = 16;         // pixels a side
constexpr int MAX_BASIS = 16;    // harmonics of a colour, up to degree 3
constexpr int MAX_WAVES = 8;     // frequencies of time in a colour, the constant one included
constexpr int HIDDEN = 64;       // units of the hidden layer of each of AGR's perceptrons
constexpr int MAX_NETWORKS = 4;  // perceptrons of AGR
constexpr int MAX_ADAM = 32;     // parameters that one call of Adam updates, or arrays that one call checks or zeroes
constexpr int MAX_VALUES = 12;   // arrays of raw parameters that AGR reads and moves

}  // namespace gsb
