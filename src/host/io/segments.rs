//! Writes a recording as segments: compressed files that together contain one text. Also finds the segments of a
//! recording. If the total size of the segments exceeds a limit, the oldest segments are deleted.
//!
//! `FILE` is written as `FILE.000001.zst`, `FILE.000002.zst` and so on. Each segment is a complete zstd frame of
//! whole lines, and begins with the text's header, so it can be read alone. Read one after another, the segments give
//! the text with repeated headers, which the reader skips. A power cut damages only the last segment, which stays
//! readable up to its last flush. The segments of an earlier run are renamed to `FILE.1.000001.zst` and so on. The
//! limit covers both runs.

use std::collections::VecDeque;
use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use zstd::stream::write::Encoder;

use super::place::with_suffix;

/// Minimum and maximum size of a segment, bytes. Smaller segments would be mostly headers. Deleting a larger segment
/// would lose days of recording.
pub const SEGMENT_BYTES: std::ops::RangeInclusive<u64> = 64 << 10..=4 << 30;
/// Default size of a segment, bytes. A pack of 96 cells fills it in six hours.
pub const DEFAULT_SEGMENT_BYTES: u64 = 64 << 20;

/// Size limits of a recording in segments.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SegmentLimits {
    /// Size of all segments together, bytes.
    pub total_bytes: u64,
    /// Size at which a segment is complete, bytes.
    pub segment_bytes: u64,
}

impl SegmentLimits {
    /// Checks limits, which must allow at least two segments: the one being written and the one before it.
    pub fn new(total_bytes: u64, segment_bytes: u64) -> Result<Self, String> {
        if !SEGMENT_BYTES.contains(&segment_bytes) {
            let (least, greatest) = (SEGMENT_BYTES.start() >> 10, SEGMENT_BYTES.end() >> 30);
            return Err(format!("a segment of {segment_bytes} bytes, must be {least} KiB to {greatest} GiB"));
        }
        if total_bytes / 2 < segment_bytes {
            return Err(format!(
                "a limit of {total_bytes} bytes, must be at least two segments of {segment_bytes} bytes"
            ));
        }
        Ok(Self { total_bytes, segment_bytes })
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Segment {
    path: PathBuf,
    number: u64,
}

fn path_of(base: &Path, number: u64) -> PathBuf {
    with_suffix(base, &format!(".{number:06}.zst"))
}

/// Splits a segment's path into base and number; `None` for other paths.
fn parse(path: &Path) -> Option<(PathBuf, u64)> {
    let text = path.to_str()?.strip_suffix(".zst")?;
    let (base, digits) = text.rsplit_once('.')?;
    // A segment's number has at least six digits.
    let is_number = digits.len() >= 6 && digits.bytes().all(|byte| byte.is_ascii_digit());
    Some((PathBuf::from(base), digits.parse().ok().filter(|_| is_number)?))
}

fn find(base: &Path) -> io::Result<Vec<Segment>> {
    let folder = base.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut segments = Vec::new();
    for entry in fs::read_dir(folder)? {
        let name = entry?.file_name();
        let path = base.with_file_name(name);
        segments.extend(parse(&path).filter(|(of, _)| of == base).map(|(_, number)| Segment { path, number }));
    }
    segments.sort_by_key(|segment| segment.number);
    Ok(segments)
}

/// The files that form one log, and the number of deleted segments before them.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct LogParts {
    pub paths: Vec<PathBuf>,
    pub deleted: u64,
}

/// Takes the next log from a list of files. The log is a single file, or consecutive segments in the list. If a name in
/// the list is not a file but the base name of segments, the log consists of all these segments.
///
/// # Errors
/// Fails if a segment is missing between two others.
pub(super) fn next_log(files: &mut VecDeque<PathBuf>) -> io::Result<Option<LogParts>> {
    let Some(first) = files.pop_front() else { return Ok(None) };
    let mut segments: Vec<Segment> = Vec::new();
    if let Some((base, number)) = parse(&first) {
        segments.push(Segment { path: first.clone(), number });
        let of_base = |path: &PathBuf| parse(path).filter(|(of, _)| *of == base);
        while let Some((_, number)) = files.front().and_then(of_base) {
            segments.extend(files.pop_front().map(|path| Segment { path, number }));
        }
    } else if !first.exists() && first != Path::new("-") {
        segments = find(&first).unwrap_or_default();
    }
    if let Some(pair) = segments.windows(2).find(|pair| pair[0].number + 1 != pair[1].number) {
        let (before, after) = (pair[0].number, pair[1].path.display());
        return Err(io::Error::other(format!("{after} follows segment {before}, must be segment {}", before + 1)));
    }
    let deleted = segments.first().map_or(0, |segment| segment.number.saturating_sub(1));
    let paths = if segments.is_empty() { vec![first] } else { segments.into_iter().map(|it| it.path).collect() };
    Ok(Some(LogParts { paths, deleted }))
}

/// Files that are read as one file. The files are opened one at a time.
pub(super) struct JoinedFiles {
    open: File,
    rest: VecDeque<PathBuf>,
}

impl JoinedFiles {
    pub(super) fn open(paths: &[PathBuf]) -> io::Result<Self> {
        let mut rest: VecDeque<PathBuf> = paths.iter().cloned().collect();
        let first = rest.pop_front().ok_or(io::ErrorKind::NotFound)?;
        Ok(Self { open: File::open(first)?, rest })
    }
}

impl Read for JoinedFiles {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        loop {
            let count = self.open.read(buffer)?;
            if count > 0 || buffer.is_empty() {
                return Ok(count);
            }
            let Some(next) = self.rest.pop_front() else { return Ok(0) };
            self.open = File::open(next)?;
        }
    }
}

#[derive(Debug)]
struct CountedFile {
    file: File,
    bytes: u64,
}

impl Write for CountedFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let count = self.file.write(bytes)?;
        self.bytes += count as u64;
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

pub(super) struct SegmentWriter {
    base: PathBuf,
    header: &'static str,
    limits: SegmentLimits,
    number: u64,
    open: Encoder<'static, CountedFile>,
    /// Complete segments and their sizes, oldest first.
    complete: VecDeque<(PathBuf, u64)>,
}

impl SegmentWriter {
    /// Renames the segments of an earlier run and starts the first segment. The text that the caller writes must begin
    /// with `header`. The writer itself begins every later segment with `header`.
    ///
    /// # Errors
    /// Fails if a file cannot be renamed, deleted or created.
    pub(super) fn create(base: &Path, header: &'static str, limits: SegmentLimits) -> io::Result<Self> {
        let complete = keep_earlier(base)?;
        let open = begin(&path_of(base, 1))?;
        Ok(Self { base: base.to_owned(), header, limits, number: 1, open, complete })
    }

    /// Appends a piece of the text and hands it to the operating system. If the segment is full, it ends after the last
    /// whole line of the piece, and the rest of the piece begins the next segment.
    pub(super) fn write(&mut self, piece: &[u8]) -> io::Result<()> {
        let is_full = self.open.get_ref().bytes >= self.limits.segment_bytes;
        let end = memchr::memrchr(b'\n', piece).filter(|_| is_full).map(|last| last + 1);
        match end {
            None => self.open.write_all(piece)?,
            Some(end) => {
                self.open.write_all(&piece[..end])?;
                self.next()?;
                self.open.write_all(&piece[end..])?;
            }
        }
        self.open.flush()?;
        self.delete_oldest()
    }

    pub(super) fn finish(mut self) -> io::Result<()> {
        self.open.do_finish()?;
        self.open.get_ref().file.sync_all()
    }

    fn next(&mut self) -> io::Result<()> {
        self.open.do_finish()?;
        let CountedFile { file, bytes } = self.open.get_ref();
        file.sync_all()?;
        self.complete.push_back((path_of(&self.base, self.number), *bytes));
        self.number += 1;
        self.open = begin(&path_of(&self.base, self.number))?;
        writeln!(self.open, "{}", self.header)
    }

    fn delete_oldest(&mut self) -> io::Result<()> {
        let total = |complete: &VecDeque<(PathBuf, u64)>| complete.iter().map(|(_, bytes)| bytes).sum::<u64>();
        while total(&self.complete) + self.open.get_ref().bytes > self.limits.total_bytes {
            let Some((path, _)) = self.complete.pop_front() else { return Ok(()) };
            remove(&path)?;
        }
        Ok(())
    }
}

fn begin(path: &Path) -> io::Result<Encoder<'static, CountedFile>> {
    // This compression level of zstd shrinks frames of a pack of 96 cells by a factor of 8.0. Level 3 gives a factor
    // of 7.2 and needs 2 MB more memory. The vehicle's package (`packaging/debian/build`) leaves out the compressors
    // of the other levels.
    Encoder::new(CountedFile { file: File::create(path)?, bytes: 0 }, 1)
}

/// Renames the segments of the last run to `base.1`. Before this, deletes the older segments that have this name.
/// Returns the renamed segments with their sizes.
fn keep_earlier(base: &Path) -> io::Result<VecDeque<(PathBuf, u64)>> {
    let earlier = with_suffix(base, ".1");
    for segment in find(&earlier)? {
        remove(&segment.path)?;
    }
    let mut kept = VecDeque::new();
    for Segment { path, number } in find(base)? {
        let to = path_of(&earlier, number);
        fs::rename(&path, &to)?;
        kept.push_back((to.clone(), fs::metadata(&to)?.len()));
    }
    Ok(kept)
}

/// Deletes a file. If the file no longer exists, this is not an error.
fn remove(path: &Path) -> io::Result<()> {
    fs::remove_file(path).or_else(|error| if error.kind() == io::ErrorKind::NotFound { Ok(()) } else { Err(error) })
}

#[cfg(test)]
mod tests;
