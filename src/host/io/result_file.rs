//! Files a command writes: complete or not at all, and every failure is reported.
//!
//! A regular file is written as `NAME.part` in the same folder and renamed when it is complete; an abandoned one is deleted.
//! `-` is standard output; a device or pipe is written directly.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};

use super::place::with_suffix;

/// A file being written.
#[derive(Debug)]
pub struct ResultFile {
    path: PathBuf,
    /// Path of the incomplete file; `None` = written in place.
    part: Option<PathBuf>,
    out: BufWriter<File>,
}

impl ResultFile {
    /// Begins to write `path`.
    ///
    /// # Errors
    /// When it cannot be created; the message names it.
    pub fn create(path: &Path) -> io::Result<Self> {
        let (file, part): (File, _) = if path == Path::new("-") {
            (io::stdout().as_fd().try_clone_to_owned()?.into(), None)
        } else if fs::metadata(path).is_ok_and(|m| !m.is_file()) {
            (File::options().write(true).open(path).map_err(|e| named(path, e))?, None)
        } else {
            let part = with_suffix(path, ".part");
            (File::create(&part).map_err(|e| named(path, e))?, Some(part))
        };
        // Bytes collected before a system call.
        Ok(Self { path: path.to_owned(), part, out: BufWriter::with_capacity(256 * 1024, file) })
    }

    /// Completes the file: everything written, on the disk, under its name.
    ///
    /// # Errors
    /// Disk full and the like; the message names the file.
    pub fn finish(mut self) -> io::Result<()> {
        self.out.flush().map_err(|e| named(&self.path, e))?;
        let Some(part) = self.part.as_ref() else { return Ok(()) };
        self.out.get_ref().sync_data().map_err(|e| named(&self.path, e))?;
        fs::rename(part, &self.path).map_err(|e| named(&self.path, e))?;
        self.part = None;
        // The new name itself must survive a power cut too.
        let folder = self.path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        fs::File::open(folder).and_then(|folder| folder.sync_all()).map_err(|e| named(&self.path, e))
    }
}

impl Write for ResultFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.out.write(bytes).map_err(|e| named(&self.path, e))
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush().map_err(|e| named(&self.path, e))
    }
}

impl Drop for ResultFile {
    fn drop(&mut self) {
        if let Some(part) = &self.part {
            // An incomplete file is deleted. A failure here cannot be reported.
            let _ = fs::remove_file(part);
        }
    }
}

/// Writes a whole file.
///
/// # Errors
/// As [`ResultFile::create`] and [`ResultFile::finish`].
pub fn write_file(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = ResultFile::create(path)?;
    file.write_all(bytes)?;
    file.finish()
}

/// Checks, before hours of work, that a result can be written to its path and is not one of the files that are read.
///
/// # Errors
/// Names the result and what is wrong with its place.
pub fn check_place<'a>(result: &Path, mut inputs: impl Iterator<Item = &'a PathBuf>) -> Result<(), String> {
    if result == Path::new("-") {
        return Ok(());
    }
    let folder = result.parent().filter(|folder| !folder.as_os_str().is_empty());
    if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
        return Err(format!("{}: cannot be written: there is no folder {}", result.display(), folder.display()));
    }
    // By whatever name.
    let place = fs::canonicalize(result).ok();
    let is_read = |input: &PathBuf| input == result || (place.is_some() && fs::canonicalize(input).ok() == place);
    if inputs.any(is_read) {
        return Err(format!("{}: is read, cannot be written too", result.display()));
    }
    Ok(())
}

/// The error with the file's name and its kind, so that a closed pipe is still recognised.
fn named(path: &Path, error: io::Error) -> io::Error {
    if error.kind() == io::ErrorKind::Interrupted {
        return error;
    }
    io::Error::new(error.kind(), format!("{}: cannot be written: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_abandoned_file_leaves_the_old_one_and_no_part() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("out.csv");
        fs::write(&path, "old").expect("written");
        let mut file = ResultFile::create(&path).expect("created");
        file.write_all(b"new").expect("buffered");
        drop(file);
        assert_eq!(fs::read_to_string(&path).expect("readable"), "old");
        assert_eq!(fs::read_dir(folder.path()).expect("readable").count(), 1);
    }

    #[test]
    fn a_result_has_a_folder_and_is_no_input_by_whatever_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let [log, other] = ["a.log", "b.log"].map(|name| folder.path().join(name));
        fs::write(&log, "").expect("written");
        let inputs = [log.clone(), PathBuf::from("-")];
        let check = |result: &Path| check_place(result, inputs.iter());
        assert_eq!((check(&other), check(Path::new("-"))), (Ok(()), Ok(())));
        let again = folder.path().join(".").join("a.log");
        assert!(check(&again).is_err_and(|error| error.ends_with("a.log: is read, cannot be written too")));
        let nowhere = folder.path().join("none").join("x.csv");
        assert!(check(&nowhere).is_err_and(|error| error.contains("there is no folder")));
    }

    #[test]
    fn a_full_disk_is_an_error_that_names_the_file() {
        let mut file = ResultFile::create(Path::new("/dev/full")).expect("opened");
        file.write_all(b"x").expect("buffered");
        let error = file.finish().expect_err("no room");
        assert!(error.to_string().starts_with("/dev/full: cannot be written"), "{error}");
    }
}
