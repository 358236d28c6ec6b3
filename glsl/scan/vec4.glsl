// Vector loads of four values: on software devices the number of accesses matters more than their
// width. The scalar tail has its own loop, because software devices also execute branches that are
// not taken. Requires `values` as a buffer of uvec4.

uint sum_of(uvec4 v) {
    return v.x + v.y + v.z + v.w;
}

uint value(uint at) {
    return values[at / 4u][at % 4u];
}
