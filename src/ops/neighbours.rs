//! Lists of the nearest control points of points, and the inverse lists by control point.

use crate::error::{Error, Result};
use crate::gpu::{Buffer, Device, Groups, Recorder, Stream, View};
use crate::kernels::deform::{
    Keys, KeysArgs, KeysParams, Nearest, NearestArgs, NearestConstants, NearestParams, Starts,
    StartsArgs, StartsParams,
};
use crate::ops::sort::{RadixSort, SortArgs, SortScratch};

/// The largest number of neighbours of a point.
pub const MOST_NEIGHBOURS: usize = 16;

/// The `k` nearest control points of each point. They are refreshed rarely and read at every step.
///
/// The neighbours of point `r` are `neighbours[r·k + s]`, nearest first; `u32::MAX` fills the places
/// without a further control point. The places that name control point `n` are
/// `place_from_sorted[starts[n]..starts[n+1]]`, in ascending order, so that sums over them have a fixed
/// order.
pub struct Neighbours {
    k: usize,
    capacity: usize,
    node_capacity: usize,
    rows: usize,
    node_count: usize,
    neighbours: Buffer<u32>,
    starts: Buffer<u32>,
    place_from_sorted: Buffer<u32>,
    sort: RadixSort,
    scratch: SortScratch,
    count: Buffer<u32>,
    keys: Buffer<u32>,
    unsorted: Buffer<u32>,
    sorted_keys: Buffer<u32>,
}

impl Neighbours {
    /// Allocates for `capacity` points with `k` neighbours each, and for `node_capacity` control points.
    ///
    /// # Errors
    /// [`Error::Input`] for `k` of 0 or beyond [`MOST_NEIGHBOURS`]; [`Error::OutOfMemory`].
    pub fn new(
        device: &Device,
        k: usize,
        capacity: usize,
        node_capacity: usize,
    ) -> Result<Neighbours> {
        if k == 0 || k > MOST_NEIGHBOURS {
            return Err(Error::Input(format!(
                "{k} control points for each point: it must be 1 to {MOST_NEIGHBOURS}"
            )));
        }
        let places = capacity * k;
        let bits = usize::BITS - node_capacity.leading_zeros();
        let sort = RadixSort::plan(device, places, 0..bits)?;
        Ok(Neighbours {
            k,
            capacity,
            node_capacity,
            rows: 0,
            node_count: 0,
            neighbours: device.buffer("neighbours", places)?,
            starts: device.buffer("neighbour starts", node_capacity + 1)?,
            place_from_sorted: device.buffer("neighbour places", places)?,
            scratch: sort.scratch(device)?,
            sort,
            count: device.buffer("neighbour count", 1)?,
            keys: device.buffer("neighbour keys", places)?,
            unsorted: device.buffer("neighbour places, unsorted", places)?,
            sorted_keys: device.buffer("neighbour keys, sorted", places)?,
        })
    }

    /// Records the search: `deform/nearest`, `deform/keys`, those of [`RadixSort::record`],
    /// `deform/starts`. It covers the points that `ids` names, or all of `positions` without `ids`, and
    /// searches among `nodes`; both hold three values a point.
    ///
    /// # Errors
    /// [`Error::Shape`] where points or control points exceed the capacity.
    pub fn refresh(
        &mut self,
        recorder: &mut Recorder,
        ids: Option<View<'_, u32>>,
        positions: View<'_, f32>,
        nodes: View<'_, f32>,
    ) -> Result<()> {
        let rows = ids.map_or(positions.len() / 3, |ids| ids.len());
        let node_count = nodes.len() / 3;
        let fits = |arg, actual: usize, most: usize| match actual <= most {
            true => Ok(()),
            false => {
                let expected = format!("at most {most}");
                Err(Error::Shape { op: "neighbours", arg, expected, actual })
            }
        };
        fits("points", rows, self.capacity)?;
        fits("nodes", node_count, self.node_capacity)?;
        (self.rows, self.node_count) = (rows, node_count);
        let limits = *recorder.device().limits();
        recorder.dispatch_specialised::<Nearest>(
            NearestConstants { k: self.k as u32 },
            Groups::linear(rows, 64, &limits)?,
            NearestParams {
                rows: rows as u32,
                node_count: node_count as u32,
                listed: u32::from(ids.is_some()),
            },
            NearestArgs {
                ids: ids.unwrap_or(self.count.view()),
                positions,
                nodes,
                neighbours: self.neighbours.view_mut(),
            },
        )?;
        self.index(recorder)
    }

    /// Waits and reads the lists of the last refresh.
    pub(crate) fn download(&self, stream: &mut Stream) -> Result<Vec<u32>> {
        let mut lists = stream.download(&self.neighbours)?;
        lists.truncate(self.rows * self.k);
        Ok(lists)
    }

    /// Restores saved lists over `node_count` control points, as a refresh would have found them.
    ///
    /// # Errors
    /// [`Error::Shape`] where the lists exceed the capacity; a failed upload.
    pub(crate) fn restore(
        &mut self,
        stream: &mut Stream,
        lists: &[u32],
        node_count: usize,
    ) -> Result<()> {
        let rows = lists.len() / self.k;
        if rows > self.capacity || node_count > self.node_capacity {
            return Err(Error::Shape {
                op: "neighbours",
                arg: "lists",
                expected: format!("at most {} of {} nodes", self.capacity, self.node_capacity),
                actual: rows,
            });
        }
        (self.rows, self.node_count) = (rows, node_count);
        stream.upload(&mut self.neighbours, lists)?;
        let mut recorder = stream.record()?;
        self.index(&mut recorder)?;
        stream.submit(recorder)?;
        Ok(())
    }

    /// Records the inverse lists by control point.
    fn index(&mut self, recorder: &mut Recorder) -> Result<()> {
        let limits = *recorder.device().limits();
        let (node_count, places) = (self.node_count, self.rows * self.k);
        recorder.dispatch::<Keys>(
            Groups::linear(places, 64, &limits)?,
            KeysParams { count: places as u32, node_count: node_count as u32 },
            KeysArgs {
                neighbours: self.neighbours.view(),
                keys: self.keys.view_mut(),
                places: self.unsorted.view_mut(),
            },
        )?;
        recorder.update(self.count.view_mut(), &[places as u32])?;
        self.sort.record(
            recorder,
            SortArgs {
                count: self.count.view(),
                count_at: 0,
                keys: self.keys.view(),
                payload: self.unsorted.view(),
                sorted_keys: self.sorted_keys.view_mut(),
                sorted_payload: self.place_from_sorted.view_mut(),
            },
            &mut self.scratch,
        )?;
        recorder.dispatch::<Starts>(
            Groups::linear(node_count + 1, 64, &limits)?,
            StartsParams { count: places as u32, node_count: node_count as u32 },
            StartsArgs { keys: self.sorted_keys.view(), starts: self.starts.view_mut() },
        )
    }

    /// Number of neighbours of each point.
    pub fn k(&self) -> usize {
        self.k
    }

    /// Number of points of the last refresh.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Number of control points of the last refresh.
    pub fn node_count(&self) -> usize {
        self.node_count
    }

    /// Neighbours of each point, nearest first.
    pub fn neighbours(&self) -> View<'_, u32> {
        self.neighbours.range(0..self.rows * self.k)
    }

    /// The begin of each control point's range in [`place_from_sorted`](Self::place_from_sorted), and the end of
    /// the last.
    pub fn starts(&self) -> View<'_, u32> {
        self.starts.range(0..self.node_count + 1)
    }

    /// Places ordered by control point; empty places come last.
    pub fn place_from_sorted(&self) -> View<'_, u32> {
        self.place_from_sorted.range(0..self.rows * self.k)
    }
}
