// Interleaving of workgroups for software devices, which assign each core one contiguous range of
// workgroups in advance. If the cost of a workgroup changes along the grid (an empty sky above a
// full ground, near splats before far ones), all cores wait for the slowest. With SPREAD, the
// workgroups of each range come from the whole grid. Requires common/grid.glsl and the
// specialisation constant SPREAD.

// The workgroup's linear index. With SPREAD the indices are permuted: they fill a table of 16
// columns row by row, and the table is read column by column.
uint spread_group_index() {
    uint group = group_index();
    if (SPREAD) {
        const uint COLUMNS = 16u;
        uint groups = gl_NumWorkGroups.x * gl_NumWorkGroups.y;
        // The first `longer` columns have one row more than the others.
        uint rows = groups / COLUMNS, longer = groups % COLUMNS;
        uint in_longer = longer * (rows + 1u);
        if (group < in_longer) {
            return group % (rows + 1u) * COLUMNS + group / (rows + 1u);
        }
        group -= in_longer;
        return group % rows * COLUMNS + longer + group / rows;
    }
    return group;
}
