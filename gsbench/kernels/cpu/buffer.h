// Scratch memory of a thread, aligned to cache lines. std::vector is not used, because the linker would merge its code
// across instruction sets.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <new>

#include "../math/scalar.h"

#if defined(_OPENMP)
#include <omp.h>
#endif

namespace gsb {
inline namespace GSB_ISA {

inline int thread_index() {
#if defined(_OPENMP)
    return omp_get_thread_num();
#else
    return 0;
#endif
}

template <class T>
class Buffer {
public:
    explicit Buffer(size_t size) : size_(size) {
        const size_t bytes = (size * sizeof(T) + 63) / 64 * 64;
        data_ = static_cast<T*>(std::aligned_alloc(64, bytes ? bytes : 64));
        if (!data_) throw std::bad_alloc();
    }
    ~Buffer() { std::free(data_); }
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;

    void zero() { __builtin_memset(data_, 0, size_ * sizeof(T)); }
    T* data() { return data_; }
    T& operator[](size_t i) { return data_[i]; }

private:
    T* data_;
    size_t size_;
};

}  // namespace GSB_ISA
}  // namespace gsb
