// Values four at a time: software devices pay for each access more than for its width. What is left
// behind the last whole four comes one by one, apart: they walk through branches not taken, too.
// Needs `values` as uvec4.

uint sum_of(uvec4 four) {
    return four.x + four.y + four.z + four.w;
}

uint value(uint at) {
    return values[at / 4u][at % 4u];
}
