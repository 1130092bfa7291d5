#!/bin/sh
# Everything that needs a GPU, in under eight minutes: build for this one, tests, compute-sanitizer, benchmarks.
# From the repository's root, offline: Python 3.11 to 3.13 with torch for CUDA, nvcc 12 or newer, CMake 3.26, ninja,
# nanobind, pytest and hypothesis. PYTHON names another interpreter. Exits with an error if any part failed.
set -u
PYTHON=${PYTHON:-python3}
BUILD=${BUILD:-build/gpu}
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}"
failed=0
part() { name=$1; shift; echo "== $name"; "$@" || { echo "== $name FAILED"; failed=1; }; }

arch=$($PYTHON -c 'import torch; print("%d%d" % torch.cuda.get_device_capability())') || {
    echo "gpu-check: torch finds no CUDA device"; exit 1; }
nvidia-smi --query-gpu=name,driver_version --format=csv,noheader
cmake -S . -B "$BUILD" -G Ninja -DCMAKE_BUILD_TYPE=Release -DCUDA=on "-DCMAKE_CUDA_ARCHITECTURES=$arch" \
    "-DPython_EXECUTABLE=$(command -v "$PYTHON")" > /dev/null && cmake --build "$BUILD" || exit 1
cp "$BUILD"/_cuda*.so "$BUILD"/_native*.so gsbench/kernels/ || exit 1

part tests "$PYTHON" -m pytest -q -p no:cacheprovider tests/kernels tests/raster
for tool in memcheck racecheck; do
    part "compute-sanitizer $tool" compute-sanitizer --tool "$tool" --error-exitcode 1 "$PYTHON" benchmarks/gpu_small.py
done
part benchmarks "$PYTHON" -m benchmarks.gpu
exit $failed
