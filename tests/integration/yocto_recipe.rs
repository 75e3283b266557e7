//! Compares the Yocto recipe (`packaging/yocto`) with the repository: installed files, version, units, licence
//! checksums and build flags. Whether bitbake accepts the recipe is checked by hand (see the manual, page Install).

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

const LAYER: &str = "packaging/yocto/meta-packwatch";

fn repository() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn recipe() -> (String, String) {
    let folder = repository().join(LAYER).join("recipes-core/packwatch");
    let recipes: Vec<PathBuf> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "bb"))
        .collect();
    let [path] = recipes.as_slice() else { panic!("found recipes {recipes:?}, must be one") };
    (path.file_name().unwrap().to_str().unwrap().to_owned(), fs::read_to_string(path).unwrap())
}

/// Words of the value that the recipe assigns to a variable, without the quotes.
fn words<'a>(text: &'a str, variable: &str) -> Vec<&'a str> {
    let (_, rest) =
        text.split_once(&format!("\n{variable} = \"")).unwrap_or_else(|| panic!("the recipe has no {variable}"));
    rest.split('"').next().unwrap().split_whitespace().filter(|word| *word != "\\").collect()
}

#[test]
fn recipe_version_matches_package() {
    assert_eq!(recipe().0, format!("packwatch_{}.bb", env!("CARGO_PKG_VERSION")));
}

#[test]
fn recipe_installs_existing_files() {
    let (_, text) = recipe();
    let sources: Vec<&str> = text.split_whitespace().filter_map(|word| word.strip_prefix("${S}/")).collect();
    assert!(sources.len() >= 8, "{sources:?}");
    for source in sources {
        let folder = source.strip_suffix("/*.toml").unwrap_or(source);
        assert!(repository().join(folder).exists(), "the recipe installs {source}, which does not exist");
    }
}

#[test]
fn recipe_installs_every_unit() {
    let (_, text) = recipe();
    let mut units: Vec<String> = fs::read_dir(repository().join("systemd"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| Path::new(name).extension().is_some_and(|extension| extension == "service"))
        .filter(|name| !is_of_the_uplink(name))
        .collect();
    let mut known = words(&text, "SYSTEMD_SERVICE:${PN}");
    units.sort();
    known.sort_unstable();
    assert_eq!(known, units);
    for unit in units {
        assert!(text.contains(&format!("${{S}}/systemd/{unit}")), "the recipe does not install {unit}");
    }
}

/// Whether a unit runs the uplink's program, which another package provides.
fn is_of_the_uplink(unit: &str) -> bool {
    let text = fs::read_to_string(repository().join("systemd").join(unit)).unwrap();
    text.contains("ExecStart=/usr/bin/packwatch-uplink ")
}

#[test]
fn licence_checksums_match_recipe() {
    let (_, text) = recipe();
    let texts = words(&text, "LIC_FILES_CHKSUM");
    assert_eq!(texts.len(), 2, "{texts:?}");
    for word in texts {
        let (file, sum) = word.strip_prefix("file://").and_then(|rest| rest.split_once(";md5=")).unwrap();
        let output = Command::new("md5sum").arg(repository().join(file)).output().unwrap();
        assert_eq!(String::from_utf8(output.stdout).unwrap().split(' ').next(), Some(sum), "{file}");
    }
}

#[test]
fn recipe_builds_same_features_as_debian_package() {
    let (_, text) = recipe();
    let script = fs::read_to_string(repository().join("packaging/program")).unwrap();
    assert_eq!(words(&text, "CARGO_PROFILE"), ["vehicle"]);
    assert!(script.contains("profile=vehicle"));
    let flags = words(&text, "CARGO_BUILD_FLAGS:append");
    assert_eq!(flags, ["--package", "packwatch", "--no-default-features"]);
    assert!(
        script.contains(" package=packwatch\n") && script.contains(r#"--package "$package" --no-default-features"#)
    );
}
