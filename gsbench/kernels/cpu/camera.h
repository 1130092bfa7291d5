// Reads a camera from the arguments of a kernel.
#pragma once

#include <cstdint>

#include "../math/projection.h"

namespace gsb {
inline namespace GSB_ISA {

template <class Number, class Args>
CameraOf<Number> camera_of(const Args& a, int64_t c) {
    const float *view = a.viewmats + c * 16, *K = a.Ks + c * 9;
    CameraOf<Number> camera;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) camera.rotation[i][j] = view[i * 4 + j];
        camera.translation[i] = view[i * 4 + 3];
    }
    camera.fx = K[0];
    camera.cx = K[2];
    camera.fy = K[4];
    camera.cy = K[5];
    camera.width = static_cast<Number>(a.width);
    camera.height = static_cast<Number>(a.height);
    camera.near = a.near;
    camera.far = a.far;
    camera.eps2d = a.eps2d;
    camera.antialias = a.antialias;
    return camera;
}

}  // namespace GSB_ISA
}  // namespace gsb
