"""Sums and minima that several cores may form at once. On a CPU, Warp's own atomics are for one core."""

import warp as wp

# Both are relaxed: nothing but the value itself is passed on, and what is read is read after the launch.


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    atomicMin((unsigned long long*)&array.data[index], (unsigned long long)key);
#else
    wp::uint64* place = &array.data[index];
    wp::uint64 present = __atomic_load_n(place, __ATOMIC_RELAXED);
    while (key < present && !__atomic_compare_exchange_n(
        place, &present, key, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
#endif
""")
def lower_to(array: wp.array(dtype=wp.uint64), index: int, key: wp.uint64):
    """Makes a key of the array the smaller one of itself and `key`."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    atomicAdd((unsigned long long*)&array.data[index], (unsigned long long)value);
#else
    __atomic_fetch_add(&array.data[index], value, __ATOMIC_RELAXED);
#endif
""")
def add_to(array: wp.array(dtype=wp.uint64), index: int, value: wp.uint64):
    """Adds to a number of the array."""
