// Arrays of Python, checked for what they hold before anything looks into them.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <initializer_list>
#include <stdexcept>
#include <string>
#include <type_traits>

namespace v2hdm {

namespace nb = nanobind;

template <typename Value, int DIMENSIONS>
using Array = nb::ndarray<Value, nb::ndim<DIMENSIONS>, nb::c_contig, nb::device::cpu>;

// An array of a type and a number of dimensions; one that is only read is copied where that takes it.
template <typename Value, int DIMENSIONS>
Array<Value, DIMENSIONS> array_of(nb::handle object, const char* name) {
    Array<Value, DIMENSIONS> array;
    if (!nb::try_cast(object, array, std::is_const_v<Value>)) {
        throw std::invalid_argument(std::string(name) + ": of another type, order or number of dimensions");
    }
    return array;
}

// The array ``name`` of an object, of a shape.
template <typename Value, int DIMENSIONS>
Array<Value, DIMENSIONS> member(nb::handle object, const char* name, std::initializer_list<size_t> shape) {
    const auto array = array_of<Value, DIMENSIONS>(object.attr(name), name);
    size_t axis = 0;
    for (const size_t size : shape) {
        if (array.shape(axis++) != size) throw std::invalid_argument(std::string(name) + ": of another shape");
    }
    return array;
}

// An array of Python, of zeros.
template <typename Value>
struct Made {
    Value* data;
    nb::object array;

    explicit Made(std::initializer_list<size_t> shape) {
        size_t size = 1;
        for (const size_t axis : shape) size *= axis;
        data = new Value[size]();
        nb::capsule owner(data, [](void* memory) noexcept { delete[] static_cast<Value*>(memory); });
        array = nb::cast(nb::ndarray<nb::numpy, Value>(data, shape, owner));
    }
};

}  // namespace v2hdm
