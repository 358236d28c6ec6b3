//! Numbers that no valid file or command line contains, as text that parses as `f64`.

/// Replacements for any number.
pub const WILD: [&str; 20] = [
    "0",
    "-0",
    "-1",
    "1e-300",
    "1e10",
    "1e19",
    "1e38",
    "1e300",
    "1e999",
    "nan",
    "NaN",
    "inf",
    "-inf",
    "65536",
    "1000000000",
    "4294967295",
    "4294967296",
    "9223372036854775808",
    "18446744073709551615",
    "18446744073709551616",
];
