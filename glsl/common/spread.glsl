// Software devices hand each core one stretch of the workgroups beforehand. Where what a workgroup
// costs changes from one end to the other (an empty sky over a full ground, near splats before far
// ones), the cores would wait for the slowest; with SPREAD every stretch gets some of everything.
// Needs common/grid.glsl, and SPREAD as a specialisation constant.

// The workgroup's number, or with SPREAD its place when the numbers are read down the columns of a
// table instead of along its rows.
uint spread_group_index() {
    uint group = group_index();
    if (SPREAD) {
        const uint COLUMNS = 16u;
        uint groups = gl_NumWorkGroups.x * gl_NumWorkGroups.y;
        // The first columns have one row more.
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
