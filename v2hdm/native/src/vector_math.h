// Elementary functions that compilers turn into vector instructions, as those of the standard library are not.
#pragma once

#include <cstdint>
#include <cstring>

namespace v2hdm {
// Of no file but the one that includes it, as each may be compiled for another processor.
namespace {

inline float float_of_bits(int32_t bits) {
    float value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

inline int32_t bits_of_float(float value) {
    int32_t bits;
    std::memcpy(&bits, &value, sizeof bits);
    return bits;
}

// The lesser, or the greater; a value that is not a number gives the bound.
inline float least(float value, float bound) { return value < bound ? value : bound; }
inline float most(float value, float bound) { return value > bound ? value : bound; }

// e^x to 2e-7 of itself, for x between -87 and 88, which others are moved to.
inline float exponential(float x) {
    x = least(most(x, -87.0f), 88.0f);
    const float in_octaves = x * 1.44269504f;
    const int32_t octave = static_cast<int32_t>(in_octaves + (in_octaves < 0.0f ? -0.5f : 0.5f));
    const float whole = static_cast<float>(octave);
    const float rest = (x - whole * 0.693359375f) + whole * 2.12194440e-4f;
    // Minimax polynomial of Cephes (Moshier, 1989).
    float value = 1.9875691500e-4f;
    value = value * rest + 1.3981999507e-3f;
    value = value * rest + 8.3334519073e-3f;
    value = value * rest + 4.1665795894e-2f;
    value = value * rest + 1.6666665459e-1f;
    value = value * rest + 5.0000001201e-1f;
    value = value * rest * rest + rest + 1.0f;
    return value * float_of_bits((octave + 127) << 23);
}

// The natural logarithm to 2e-7, for normal positive numbers.
inline float logarithm(float x) {
    const int32_t bits = bits_of_float(x);
    // The mantissa is brought between sqrt(1/2) and sqrt(2).
    const int32_t shifted = bits - 0x3f3504f3;
    const int32_t octave = shifted >> 23;
    const float mantissa = float_of_bits(bits - static_cast<int32_t>(static_cast<uint32_t>(octave) << 23));
    const float rest = mantissa - 1.0f;
    const float square = rest * rest;
    // Minimax polynomial of Cephes (Moshier, 1989).
    float value = 7.0376836292e-2f;
    value = value * rest - 1.1514610310e-1f;
    value = value * rest + 1.1676998740e-1f;
    value = value * rest - 1.2420140846e-1f;
    value = value * rest + 1.4249322787e-1f;
    value = value * rest - 1.6668057665e-1f;
    value = value * rest + 2.0000714765e-1f;
    value = value * rest - 2.4999993993e-1f;
    value = value * rest + 3.3333331174e-1f;
    value = value * rest * square;
    const float whole = static_cast<float>(octave);
    value += whole * -2.12194440e-4f - 0.5f * square;
    return (rest + value) + whole * 0.693359375f;
}

}  // namespace
}  // namespace v2hdm
