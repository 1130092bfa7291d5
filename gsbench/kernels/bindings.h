// The bindings between Python and the kernels: a call passes one number for each field of a kernel's argument
// structures, with addresses of arrays as integers. gsbench/kernels/operation.py has checked the arrays before; only
// the number and the types of the values are checked here.
//
// Tensors are passed as addresses because a DLPack capsule costs microseconds per tensor, as much as a small kernel.
#pragma once

#include <nanobind/nanobind.h>

#include <string>
#include <string_view>
#include <tuple>
#include <type_traits>

namespace gsb {

// The role (INPUTS, OUTPUTS, ..), the field names and references to the fields of a structure S.
template <class S>
struct Fields;

}  // namespace gsb

// In Python, fields of INPUTS have their own names; other fields have a prefix that names their role (library.py).
#define GSB_FIELDS(Structure, role, ...)                                                     \
    template <>                                                                              \
    struct Fields<Structure> {                                                               \
        static constexpr std::string_view kind = #role;                                      \
        static constexpr std::string_view names = #__VA_ARGS__;                              \
        static auto all(Structure& s) {                                                      \
            [[maybe_unused]] auto& [__VA_ARGS__] = s; /* as many as the structure has */     \
            return std::tie(GSB_EACH(__VA_ARGS__));                                          \
        }                                                                                    \
    };
#define GSB_EACH(...) GSB_EXPAND(GSB_EACH_(__VA_ARGS__))
#define GSB_EACH_(field, ...) s.field __VA_OPT__(, GSB_EACH_AGAIN GSB_PARENTHESES(__VA_ARGS__))
#define GSB_EACH_AGAIN() GSB_EACH_
#define GSB_PARENTHESES ()
#define GSB_EXPAND(...) GSB_EXPAND_3(GSB_EXPAND_3(GSB_EXPAND_3(__VA_ARGS__)))
#define GSB_EXPAND_3(...) GSB_EXPAND_2(GSB_EXPAND_2(GSB_EXPAND_2(__VA_ARGS__)))
#define GSB_EXPAND_2(...) GSB_EXPAND_1(GSB_EXPAND_1(GSB_EXPAND_1(__VA_ARGS__)))
#define GSB_EXPAND_1(...) __VA_ARGS__

#include "arguments.h"

namespace gsb::bindings {

namespace nb = nanobind;

inline void check(bool good) {
    if (!good) throw nb::python_error();
}

// Converts one Python number to one field.
template <class T>
void read(PyObject* from, T& to) {
    if constexpr (std::is_pointer_v<T>) {
        to = static_cast<T>(PyLong_AsVoidPtr(from));
    } else if constexpr (std::is_floating_point_v<T>) {
        to = static_cast<T>(PyFloat_AsDouble(from));
    } else {
        to = static_cast<T>(PyLong_AsLongLong(from));
    }
    check(!PyErr_Occurred());
}

// Converts a Python tuple to a field that is an array; its remaining entries stay zero.
template <class T, size_t n>
void read(PyObject* from, T (&to)[n]) {
    if (!PyTuple_Check(from) || PyTuple_GET_SIZE(from) > static_cast<Py_ssize_t>(n)) {
        throw nb::type_error(("expected a tuple of at most " + std::to_string(n) + " numbers").c_str());
    }
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(from); ++i) read(PyTuple_GET_ITEM(from, i), to[i]);
}

// Fills a structure from `values`, starting at the index `at`, and advances `at`.
template <class S>
void fill(S& s, PyObject* values, Py_ssize_t& at) {
    std::apply([&](auto&... field) { (read(PyTuple_GET_ITEM(values, at++), field), ...); }, Fields<S>::all(s));
}

// Fills an address that is not a field of a structure.
template <class T>
void fill(T*& address, PyObject* values, Py_ssize_t& at) {
    read(PyTuple_GET_ITEM(values, at++), address);
}

template <class S>
constexpr size_t count = std::tuple_size_v<decltype(Fields<S>::all(std::declval<S&>()))>;

// Returns the role and the field names of each structure, such as ("INPUTS", "N, means, ..").
template <class... S>
nb::tuple signature() {
    const auto one = [](std::string_view kind, std::string_view names) {
        return nb::make_tuple(nb::str(kind.data(), kind.size()), nb::str(names.data(), names.size()));
    };
    return nb::make_tuple(one(Fields<S>::kind, Fields<S>::names)...);
}

// Defines the Python function m.name(*values) and m.SIGNATURES[name]. `run` is called without the GIL, with the
// structures and with an address of each type in `Last`. These addresses are the last values of the call: on a GPU, the
// stream.
template <class... S, class Run, class... Last>
void define(nb::module_& m, const char* name, Run run, Last*...) {
    nb::dict signatures = nb::cast<nb::dict>(m.attr("SIGNATURES"));
    signatures[name] = signature<S...>();
    m.def(name, [run](const nb::args& values) {
        constexpr size_t expected = (count<S> + ... + sizeof...(Last));
        if (values.size() != expected) {
            throw nb::type_error(("expected " + std::to_string(expected) + " values").c_str());
        }
        std::tuple<S..., Last*...> arguments{};
        Py_ssize_t at = 0;
        std::apply([&](auto&... argument) { (fill(argument, values.ptr(), at), ...); }, arguments);
        nb::gil_scoped_release release;
        return std::apply(run, arguments);
    });
}

}  // namespace gsb::bindings
