//! Writes the result files of a command. A regular file is written completely or not at all. If a write fails, the
//! error names the file.
//!
//! A regular file is written as `NAME.part` in the same folder and renamed when it is complete. If the command fails,
//! `NAME.part` is deleted. The path `-` means standard output. A device or pipe is written directly.

use std::fs::{self, File};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};

use super::place::with_suffix;

/// A file being written.
#[derive(Debug)]
pub struct ResultFile {
    path: PathBuf,
    /// Path of the incomplete file; `None` = the final path is written directly.
    part: Option<PathBuf>,
    out: BufWriter<File>,
}

impl ResultFile {
    /// Starts writing `path`.
    ///
    /// # Errors
    /// Fails if the file cannot be created; the message names it.
    pub fn create(path: &Path) -> io::Result<Self> {
        let (file, part): (File, _) = if path == Path::new("-") {
            (io::stdout().as_fd().try_clone_to_owned()?.into(), None)
        } else if fs::metadata(path).is_ok_and(|m| !m.is_file()) {
            (File::options().write(true).open(path).map_err(|e| named(path, e))?, None)
        } else {
            let part = with_suffix(path, ".part");
            (File::create(&part).map_err(|e| named(path, name_folder(path, e)))?, Some(part))
        };
        Ok(Self { path: path.to_owned(), part, out: BufWriter::with_capacity(256 * 1024, file) })
    }

    /// Completes the file. If the function succeeds, all bytes of a regular file are on disk under the final name.
    ///
    /// # Errors
    /// Fails if the file cannot be written; the message names it.
    pub fn finish(mut self) -> io::Result<()> {
        self.out.flush().map_err(|e| named(&self.path, e))?;
        let Some(part) = self.part.as_ref() else { return Ok(()) };
        self.out.get_ref().sync_data().map_err(|e| named(&self.path, e))?;
        fs::rename(part, &self.path).map_err(|e| named(&self.path, e))?;
        self.part = None;
        // The new name must also survive a power cut.
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

impl Seek for ResultFile {
    /// Fails if the file is a pipe.
    fn seek(&mut self, place: SeekFrom) -> io::Result<u64> {
        self.out.seek(place).map_err(|e| named(&self.path, e))
    }
}

impl Drop for ResultFile {
    fn drop(&mut self) {
        if let Some(part) = &self.part {
            // Deletes an incomplete file. A failure here cannot be reported.
            let _ = fs::remove_file(part);
        }
    }
}

/// Writes a whole file.
pub fn write_file(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = ResultFile::create(path)?;
    file.write_all(bytes)?;
    file.finish()
}

/// Checks that the result's folder exists and that the result is not one of the inputs. Commands call this function
/// first, before hours of work.
///
/// # Errors
/// Returns an error that states the result's path and the fault.
pub fn check_place<'a>(result: &Path, mut inputs: impl Iterator<Item = &'a PathBuf>) -> Result<(), String> {
    if result == Path::new("-") {
        return Ok(());
    }
    let folder = result.parent().filter(|folder| !folder.as_os_str().is_empty());
    if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
        return Err(format!("{}: cannot be written: folder {} does not exist", result.display(), folder.display()));
    }
    // The canonical path detects the same file under another name.
    let place = fs::canonicalize(result).ok();
    let is_read = |input: &PathBuf| input == result || (place.is_some() && fs::canonicalize(input).ok() == place);
    if inputs.any(is_read) {
        return Err(format!("{}: is an input, must not be the output too", result.display()));
    }
    Ok(())
}

/// If a file cannot be created because its folder is missing, returns an error that names the folder. Returns other
/// errors unchanged.
pub(super) fn name_folder(path: &Path, error: io::Error) -> io::Error {
    match path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        Some(folder) if error.kind() == io::ErrorKind::NotFound && !folder.is_dir() => {
            io::Error::new(error.kind(), format!("folder {} does not exist", folder.display()))
        }
        _ => error,
    }
}

/// Adds the file's name to an error. The kind of the error is kept, so that a closed pipe is still recognised.
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
    fn abandoned_file_leaves_old_content() {
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
    fn result_needs_folder_and_must_differ_from_inputs() {
        let folder = tempfile::tempdir().expect("a folder");
        let [log, other] = ["a.log", "b.log"].map(|name| folder.path().join(name));
        fs::write(&log, "").expect("written");
        let inputs = [log.clone(), PathBuf::from("-")];
        let check = |result: &Path| check_place(result, inputs.iter());
        assert_eq!((check(&other), check(Path::new("-"))), (Ok(()), Ok(())));
        let again = folder.path().join(".").join("a.log");
        assert!(check(&again).is_err_and(|error| error.ends_with("a.log: is an input, must not be the output too")));
        let nowhere = folder.path().join("none").join("x.csv");
        assert!(check(&nowhere).is_err_and(|error| error.ends_with("does not exist")));
    }

    #[test]
    fn full_disk_error_names_file() {
        let mut file = ResultFile::create(Path::new("/dev/full")).expect("opened");
        file.write_all(b"x").expect("buffered");
        let error = file.finish().expect_err("the disk is full");
        assert!(error.to_string().starts_with("/dev/full: cannot be written"), "{error}");
    }
}
