// Vector loads of four values: on software devices an access costs more than its width. The scalar
// tail has a loop of its own, because software devices also execute branches that are not taken.
// Needs `values` as uvec4.

uint sum_of(uvec4 v) {
    return v.x + v.y + v.z + v.w;
}

uint value(uint at) {
    return values[at / 4u][at % 4u];
}
