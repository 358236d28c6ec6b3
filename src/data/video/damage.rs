//! Detection of the intact frames of a damaged video.
//!
//! A frame is intact if it is decoded at all, if a decoder without error concealment (`-err_detect
//! explode`) accepts its data, if the demuxer does not report it as corrupt, and if the same holds for all
//! frames that it may be predicted from: those before it in decoding order, back to the last key frame.

use std::collections::{HashMap, HashSet};
use std::ffi::OsStr;

use serde_json::Value;

use super::{Told, probe, stream};

/// Result of the inspection.
pub struct Seen {
    /// Whether each frame of the video is intact, in presentation order.
    pub whole: Vec<bool>,
    /// Numbers of the frames that ffmpeg outputs, in output order.
    pub decoded: Vec<usize>,
    /// Number of frames that the file declares but does not contain.
    pub missing: usize,
    /// Number of all frames of the video, where the file declares it or no frame can be missing unnoticed.
    pub total: Option<usize>,
}

impl Seen {
    /// Whether the frames that are not intact account for all damage that ffmpeg reports.
    pub fn finds_all(&self) -> bool {
        self.missing == 0 && self.total.is_some() && self.whole.contains(&false)
    }
}

/// Time of a packet without a time stamp.
const NO_TIME: i64 = i64::MIN;

/// One compressed frame.
struct Packet {
    time: i64,
    key: bool,
    /// Decoded, but not shown.
    hidden: bool,
}

/// Inspects a video; `said` are the messages of ffmpeg. `None` where `ffprobe` gives nothing.
pub fn inspect(ffprobe: &OsStr, input: &OsStr, told: &Told, said: &str) -> Option<Seen> {
    let list = |detect: &[&str]| {
        let index = told.index.to_string();
        let entries = "packet=pts,dts,flags:frame=best_effort_timestamp";
        let mut arguments = detect.to_vec();
        arguments.extend(["-threads", "1", "-select_streams", &index, "-show_packets"]);
        arguments.extend(["-show_frames", "-show_entries", entries, "-of", "json"]);
        probe(ffprobe, input, &arguments).map(|mut all| all["packets_and_frames"].take())
    };
    let usual = list(&[])?;
    let strict = list(&["-err_detect", "explode"])?;
    let corrupt = corrupt_packets(said, told.index);
    let mut spoilt = HashSet::new();
    let packets: Vec<Packet> = of(&usual, "packet")
        .map(|packet| {
            let (pts, dts) = (packet["pts"].as_i64(), packet["dts"].as_i64());
            let flags = packet["flags"].as_str().unwrap_or_default();
            let time = pts.or(dts).unwrap_or(NO_TIME);
            if flags.contains('C') || dts.is_some_and(|dts| corrupt.contains(&dts)) {
                spoilt.insert(time);
            }
            Packet { time, key: flags.contains('K'), hidden: flags.contains('D') }
        })
        .collect();
    let shown = of(&usual, "frame").filter_map(|frame| frame["best_effort_timestamp"].as_i64());
    let shown: Vec<i64> = shown.collect();
    let out: HashSet<i64> = shown.iter().copied().collect();
    // A decoder that rejects a packet outputs nothing in that step, not even a reordered frame that was
    // waiting: the step counts, not the frame that is missing.
    let steps = |list: &Value| -> Vec<usize> {
        let mut steps = Vec::new();
        for entry in list.as_array().into_iter().flatten() {
            match (entry["type"].as_str(), steps.last_mut()) {
                (Some("packet"), _) => steps.push(0),
                (Some("frame"), Some(frames)) => *frames += 1,
                _ => {}
            }
        }
        steps
    };
    let refused = steps(&usual).into_iter().zip(steps(&strict)).map(|(all, some)| some < all);
    spoilt.extend(packets.iter().zip(refused).filter(|(_, refused)| *refused).map(|(p, _)| p.time));
    spoilt.extend(
        packets.iter().map(|packet| packet.time).filter(|t| *t != NO_TIME && !out.contains(t)),
    );
    let spoilt = spread(&packets, &spoilt);

    let visible = packets.iter().filter(|p| !p.hidden && p.time != NO_TIME).map(|p| p.time);
    let mut numbers: Vec<i64> = visible.chain(shown.iter().copied()).collect();
    numbers.sort_unstable();
    numbers.dedup();
    let whole: Vec<bool> = numbers.iter().map(|time| !spoilt.contains(time)).collect();
    let number: HashMap<i64, usize> = numbers.iter().enumerate().map(|(n, &t)| (t, n)).collect();
    // An edit list hides frames that the file declares.
    let hides = packets.iter().any(|packet| packet.hidden);
    let announced = told.announced.filter(|_| !hides);
    let missing = announced.map_or(0, |all| all.saturating_sub(whole.len()));
    let gapless = match announced {
        Some(all) => all == whole.len(),
        None => !said.lines().any(|line| told.of_container(line)),
    };
    Some(Seen {
        missing,
        total: gapless.then_some(whole.len()),
        decoded: shown.iter().filter_map(|time| number.get(time).copied()).collect(),
        whole,
    })
}

/// Packets or frames in `ffprobe`'s list.
fn of<'a>(list: &'a Value, kind: &'a str) -> impl Iterator<Item = &'a Value> {
    list.as_array().into_iter().flatten().filter(move |entry| entry["type"] == kind)
}

/// The decoding times that ffmpeg reports as corrupt: `Packet corrupt (stream = 0, dts = 306000)`.
fn corrupt_packets(said: &str, index: usize) -> HashSet<i64> {
    let of_line = |line: &str| {
        let (_, after) = line.split_once("Packet corrupt")?;
        let (_, time) = after.split_once("dts = ").filter(|_| stream(after) == Some(index))?;
        time.split([')', ',']).next()?.trim().parse().ok()
    };
    said.lines().filter_map(of_line).collect()
}

/// The damaged packets and all that may be predicted from them; packets are in decoding order.
fn spread(packets: &[Packet], spoilt: &HashSet<i64>) -> HashSet<i64> {
    let mut all = HashSet::new();
    // Whether packets since the last key frame are damaged, and those before it; the key frame's time.
    let (mut on, mut before, mut key) = (false, false, i64::MIN);
    for packet in packets {
        let itself = spoilt.contains(&packet.time);
        if packet.key {
            (before, on, key) = (on, itself, packet.time);
        }
        on |= itself;
        // Packets that are decoded after a key frame and shown before it depend on both sides.
        if on || (before && packet.time < key) {
            all.insert(packet.time);
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn damage_spreads_to_the_next_key_frame() {
        let packet = |(time, key): (i64, bool)| Packet { time, key, hidden: false };
        let order =
            [(0, true), (2, false), (1, false), (5, true), (3, false), (6, false), (8, true)];
        let packets: Vec<Packet> = order.into_iter().map(packet).collect();
        let spoilt = |times: &[i64]| {
            let mut all: Vec<i64> =
                spread(&packets, &times.iter().copied().collect()).into_iter().collect();
            all.sort_unstable();
            all
        };
        assert!(spoilt(&[]).is_empty());
        assert_eq!(spoilt(&[2]), [1, 2, 3]);
        assert_eq!(spoilt(&[5]), [3, 5, 6]);
        assert_eq!(spoilt(&[6]), [6]);
        assert_eq!(spoilt(&[8]), [8]);
    }

    #[test]
    fn packets_that_the_demuxer_calls_corrupt() {
        let said = "[mpegts @ 0x5] [warning] Packet corrupt (stream = 0, dts = 306000).\n\
                    [mpegts @ 0x5] [warning] Packet corrupt (stream = 1, dts = 7).\nelse";
        assert_eq!(corrupt_packets(said, 0), HashSet::from([306000]));
        assert_eq!(corrupt_packets(said, 1), HashSet::from([7]));
    }
}
