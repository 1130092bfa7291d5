// The mathematics of one Gaussian and of one pixel, each function with its derivative beside it, for every backend.
//
// Written once, for a type T that is `float` (CUDA, one Gaussian or pixel a thread) or a SIMD vector (CPU, sixteen).
// Derivatives are vector-Jacobian products: given the gradient of the loss by a function's outputs, they return or add
// that by its inputs. Names of gradients start with g_.
#pragma once

#include "math/awake.h"
#include "math/blending.h"
#include "math/harmonics.h"
#include "math/parameters.h"
#include "math/projection.h"
#include "math/rotated.h"
#include "math/scalar.h"
#include "math/similarity.h"
#include "math/slicing.h"
#include "math/static.h"
#include "math/static_triangular.h"
#include "math/triangular.h"
