#!/bin/sh
# Runs the kernel tests on kernels built with AddressSanitizer and UndefinedBehaviorSanitizer, those for CUDA by the shim
# that runs them on the CPU; then these once more with ThreadSanitizer, for races between the threads of a block. Any
# finding is a failure.
# Usage: tests/kernels/sanitize.sh [python]
set -eu
cd "$(dirname "$0")/../.."
python=${1:-python}
build=build/sanitize
# One instruction set, the best this machine has: the sources are the same, and sanitized ones compile slowly.
cmake -S . -B $build -DCMAKE_BUILD_TYPE=RelWithDebInfo -DGSB_LEVELS=native -DGSB_SANITIZE=address,undefined \
    -DCUDA=off -DPython_EXECUTABLE="$("$python" -c "import sys; print(sys.executable)")"
cmake --build $build
rm -rf $build/site
mkdir -p $build/site
cp -r gsbench conf $build/site/
rm -f $build/site/gsbench/kernels/_cuda*.so
cp --remove-destination $build/_native*.so $build/site/gsbench/kernels/
# An editable install finds gsbench by a hook that goes before every path: without it, and the kernels that are asked for.
run="import sys
sys.meta_path[:] = [finder for finder in sys.meta_path if 'Redirecting' not in type(finder).__name__]
sys.path.insert(0, '$PWD/$build/site')
from gsbench import kernels
assert '$build' in kernels.native().__file__, kernels.native().__file__
import pytest
sys.exit(pytest.main(sys.argv[1:]))"
# The first test that needs the CUDA kernels builds them by the shim, sanitized: that may take longer than pytest allows a
# test. They are kept for the next call.
limit="timeout=3600"
# Python itself is not sanitized: the runtime is loaded first, and what the interpreter leaves behind is no leak of ours.
LD_PRELOAD="$(c++ -print-file-name=libasan.so) $(c++ -print-file-name=libstdc++.so)" \
    ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1 OMP_NUM_THREADS=2 \
    GSBENCH_SANITIZE=address,undefined GSBENCH_SHIM_BUILD=$build/shim \
    "$python" -c "$run" tests/kernels -o "pythonpath=. tests" -o "$limit" -p no:cacheprovider \
    --ignore tests/kernels/test_cuda_compiles.py  # nvcc does not run with that runtime loaded
# Only the CUDA kernels are built with ThreadSanitizer: what else runs is not looked at. It needs addresses not shuffled.
LD_PRELOAD="$(c++ -print-file-name=libtsan.so) $(c++ -print-file-name=libstdc++.so)" \
    TSAN_OPTIONS=halt_on_error=1:ignore_noninstrumented_modules=1 OMP_NUM_THREADS=1 GSBENCH_SANITIZE=thread \
    GSBENCH_SHIM_BUILD=$build/shim_of_threads \
    setarch "$(uname -m)" -R "$python" -m pytest -o "$limit" tests/kernels -k cuda -p no:cacheprovider \
    --ignore tests/kernels/test_cuda_compiles.py
