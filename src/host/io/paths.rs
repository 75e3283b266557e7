//! Checks the file names of a command for duplicates, and creates short names that distinguish the files.

use std::path::{Path, PathBuf};

/// Checks that no file is given twice.
pub fn check_distinct(files: &[PathBuf]) -> Result<(), String> {
    match files.iter().enumerate().find(|(index, file)| files[..*index].contains(file)) {
        Some((_, file)) => Err(format!("{}: named twice", file.display())),
        None => Ok(()),
    }
}

/// Short names that distinguish the files: folder and name without extensions. If two short names are equal, both files
/// get their whole path.
pub fn short_names(files: &[PathBuf]) -> Vec<String> {
    let short = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let name = name.split('.').next().unwrap_or_default().to_owned();
        let folder = path.parent().and_then(Path::file_name).map(|folder| folder.to_string_lossy().into_owned());
        folder.map_or(name.clone(), |folder| format!("{folder}/{name}"))
    };
    let all: Vec<String> = files.iter().map(short).collect();
    let is_twice = |name: &String| all.iter().filter(|other| *other == name).count() > 1;
    let full =
        |(name, path): (&String, &PathBuf)| if is_twice(name) { path.display().to_string() } else { name.clone() };
    all.iter().zip(files).map(full).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_names_distinguish_files() {
        let files = ["a/25C/x.csv.gz", "a/10C/x.csv.gz", "b/10C/x.csv", "y.csv"].map(PathBuf::from);
        assert_eq!(short_names(&files), ["25C/x", "a/10C/x.csv.gz", "b/10C/x.csv", "y"]);
    }
}
