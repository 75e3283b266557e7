//! Tests writing segments and reading them back.

#![allow(clippy::unwrap_used, reason = "tests may panic")]

use super::*;

const HEADER: &str = "HEAD";

/// Creates lines that compress badly, so that segments fill.
fn text(lines: u64) -> Vec<String> {
    let mut state = 1_u64;
    let mut number = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        state >> 16
    };
    let mut lines: Vec<String> =
        (0..lines).map(|line| format!("{line} {:012x}{:012x}\n", number(), number())).collect();
    lines.insert(0, format!("{HEADER}\n"));
    lines
}

fn write(base: &Path, limits: SegmentLimits, lines: &[String]) {
    let mut writer = SegmentWriter::create(base, HEADER, limits).unwrap();
    let whole = lines.concat();
    whole.as_bytes().chunks(5_001).for_each(|piece| writer.write(piece).unwrap());
    writer.finish().unwrap();
}

fn read(parts: &LogParts) -> String {
    let joined = JoinedFiles::open(&parts.paths).unwrap();
    let mut text = String::new();
    zstd::stream::read::Decoder::new(joined).unwrap().read_to_string(&mut text).unwrap();
    text
}

fn parts_of(files: &[PathBuf]) -> io::Result<LogParts> {
    next_log(&mut files.iter().cloned().collect()).map(Option::unwrap)
}

const SMALL: SegmentLimits = SegmentLimits { total_bytes: 10 << 20, segment_bytes: 64 << 10 };

#[test]
fn segments_join_to_text_with_repeated_headers() {
    let folder = tempfile::tempdir().unwrap();
    let base = folder.path().join("journal");
    let lines = text(20_000);
    write(&base, SMALL, &lines);
    let parts = parts_of(std::slice::from_ref(&base)).unwrap();
    assert!(parts.paths.len() >= 4 && parts.deleted == 0, "{parts:?}");
    let segments: Vec<String> =
        parts.paths.iter().map(|path| read(&LogParts { paths: vec![path.clone()], deleted: 0 })).collect();
    assert!(segments.iter().all(|segment| segment.starts_with(HEADER) && segment.ends_with('\n')));
    let whole = read(&parts);
    assert_eq!(whole, segments.concat());
    let without: String = whole.split_inclusive('\n').filter(|line| line.trim_end() != HEADER).collect();
    assert_eq!(without, lines[1..].concat());
    assert_eq!(parts_of(&parts.paths).unwrap(), parts, "segments that are named one by one form the same log");
}

#[test]
fn oldest_segments_are_deleted_beyond_limit() {
    let folder = tempfile::tempdir().unwrap();
    let base = folder.path().join("journal");
    let limits = SegmentLimits { total_bytes: 200 << 10, ..SMALL };
    let lines = text(40_000);
    write(&base, limits, &lines);
    let parts = parts_of(std::slice::from_ref(&base)).unwrap();
    let bytes: u64 = parts.paths.iter().map(|path| fs::metadata(path).unwrap().len()).sum();
    assert!(parts.deleted > 0 && bytes <= limits.total_bytes, "{} deleted, {bytes} bytes", parts.deleted);
    assert!(bytes > limits.total_bytes / 2, "only as many segments are deleted as necessary: {bytes} bytes");
    assert!(read(&parts).ends_with(lines.last().unwrap()), "the newest segments are kept");
}

#[test]
fn earlier_run_is_kept_within_limit() {
    let folder = tempfile::tempdir().unwrap();
    let base = folder.path().join("journal");
    let limits = SegmentLimits { total_bytes: 300 << 10, ..SMALL };
    write(&base, limits, &text(5_000));
    let first = read(&parts_of(std::slice::from_ref(&base)).unwrap());
    write(&base, limits, &text(100));
    let earlier = folder.path().join("journal.1");
    assert_eq!(read(&parts_of(std::slice::from_ref(&earlier)).unwrap()), first);
    write(&base, limits, &text(40_000));
    let bytes: u64 = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().metadata().unwrap().len()).sum();
    assert!(bytes <= limits.total_bytes, "{bytes} bytes");
    assert!(find(&earlier).unwrap().is_empty(), "segments of the earlier run are deleted first");
}

#[test]
fn torn_segment_is_readable_to_last_flush() {
    let folder = tempfile::tempdir().unwrap();
    let base = folder.path().join("journal");
    let mut writer = SegmentWriter::create(&base, HEADER, SMALL).unwrap();
    let lines = text(500).concat();
    writer.write(lines.as_bytes()).unwrap();
    // A power cut at this point leaves a frame without an end.
    let torn = fs::read(path_of(&base, 1)).unwrap();
    let mut decoder = zstd::stream::read::Decoder::new(torn.as_slice()).unwrap();
    let mut found = vec![0; lines.len()];
    decoder.read_exact(&mut found).unwrap();
    assert_eq!(found, lines.as_bytes());
    assert!(decoder.read(&mut [0; 8]).is_err(), "the missing end is detected");
}

#[test]
fn missing_segment_is_rejected_other_files_ignored() {
    let folder = tempfile::tempdir().unwrap();
    let base = folder.path().join("journal");
    write(&base, SMALL, &text(20_000));
    for name in ["journal", "journal.old.zst", "journal.000001.zst.bak", "other.000009.zst"] {
        fs::write(folder.path().join(name), "").unwrap();
    }
    let plain = parts_of(std::slice::from_ref(&base)).unwrap();
    assert_eq!(plain.paths, std::slice::from_ref(&base), "if a file has the base name, it is the log");
    fs::remove_file(&base).unwrap();
    fs::remove_file(path_of(&base, 2)).unwrap();
    let error = parts_of(std::slice::from_ref(&base)).unwrap_err().to_string();
    assert!(error.ends_with("journal.000003.zst follows segment 1, must be segment 2"), "{error}");
}

#[test]
fn limits_allow_two_segments() {
    assert!(SegmentLimits::new(128 << 20, 64 << 20).is_ok());
    let refused = |total, segment| SegmentLimits::new(total, segment).unwrap_err();
    assert!(refused(100 << 20, 64 << 20).contains("must be at least two segments"));
    assert!(refused(1 << 30, 1000).contains("must be 64 KiB to 4 GiB"));
}
