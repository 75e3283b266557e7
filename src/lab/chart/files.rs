//! Writes pictures as files: self-contained SVG, light or dark as the viewer prefers, and PNG.

use std::path::Path;
use std::sync::Arc;

use resvg::tiny_skia::{Pixmap, Transform};
use resvg::usvg::{Options, Tree, fontdb};

use super::style::{fixed, variables};
use super::{Picture, Size, escape};

/// Space around a picture in a file, pixels.
const MARGIN: f64 = 14.0;
/// Pixels of a PNG per pixel of the picture: sharp on paper.
const DENSITY: f32 = 2.0;
/// Preferred fonts, tried in this order.
const FAMILIES: [&str; 5] = ["DejaVu Sans", "Noto Sans", "Liberation Sans", "Arial", "Roboto"];

/// File format of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    Svg,
    Png,
}

/// Why there is no plot.
#[derive(Debug, thiserror::Error)]
#[error("{path}: the plot cannot be written: {what}")]
pub struct PlotError {
    path: String,
    what: String,
}

/// Writes one picture.
///
/// # Errors
/// The file cannot be written, or there is no font for the words of a PNG.
pub fn write(path: &Path, picture: &Picture, format: Format) -> Result<(), PlotError> {
    write_stack(path, std::slice::from_ref(picture), format)
}

/// Writes each picture under its name into a folder, as SVG and PNG.
///
/// # Errors
/// A file cannot be written, or there is no font for the words of a PNG.
pub fn write_all(folder: &Path, pictures: &[(String, Picture)]) -> Result<(), PlotError> {
    for (name, picture) in pictures {
        write(&folder.join(format!("{name}.svg")), picture, Format::Svg)?;
        write(&folder.join(format!("{name}.png")), picture, Format::Png)?;
    }
    Ok(())
}

/// Writes pictures one below the other.
///
/// # Errors
/// As [`write`].
pub fn write_stack(path: &Path, pictures: &[Picture], format: Format) -> Result<(), PlotError> {
    let failed = |what: String| PlotError { path: path.display().to_string(), what };
    let bytes = match format {
        Format::Svg => document(pictures, &variables()).into_bytes(),
        Format::Png => png(&document(pictures, &fixed())).map_err(failed)?,
    };
    crate::write_file(path, &bytes).map_err(|error| failed(error.to_string()))
}

/// An SVG document.
fn document(pictures: &[Picture], style: &str) -> String {
    let mut body = String::new();
    let mut y = MARGIN;
    for picture in pictures {
        let (elements, height) = picture.draw(Size::WIDE);
        body.push_str(&format!("<g transform=\"translate({MARGIN} {y:.1})\">{elements}</g>\n"));
        y += height + 12.0;
    }
    let (width, height) = (Size::WIDE.width + 2.0 * MARGIN, y);
    let name = pictures.first().map_or("", |picture| picture.title());
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height:.1}\" width=\"{width}\" height=\"{height:.1}\">\
         <title>{}</title><style>{style}</style><rect class=\"p\" width=\"100%\" height=\"100%\"/>\n{body}</svg>\n",
        escape(name)
    )
}

/// A picture of an SVG document.
fn png(svg: &str) -> Result<Vec<u8>, String> {
    let mut fonts = fontdb::Database::new();
    fonts.load_system_fonts();
    let known = |family: &&str| fonts.faces().any(|face| face.families.iter().any(|(name, _)| name == *family));
    let first = fonts.faces().next().and_then(|face| Some(face.families.first()?.0.clone()));
    let Some(family) = FAMILIES.iter().find(|family| known(family)).map(|family| (*family).to_owned()).or(first) else {
        return Err("no font is installed (a PNG would have no words); install one, or use the SVG".to_owned());
    };
    fonts.set_sans_serif_family(&family);
    let options = Options { font_family: family, fontdb: Arc::new(fonts), ..Options::default() };
    let tree = Tree::from_str(svg, &options).map_err(|error| error.to_string())?;
    let size = tree.size().to_int_size().scale_by(DENSITY).ok_or("the picture is too large")?;
    let mut pixels = Pixmap::new(size.width(), size.height()).ok_or("the picture is too large")?;
    resvg::render(&tree, Transform::from_scale(DENSITY, DENSITY), &mut pixels.as_mut());
    pixels.encode_png().map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chart::{Axis, Chart, Ink, Layer, Shape};

    fn picture() -> Picture {
        let layers = vec![Layer::new("95 %", Ink::Blue, Shape::Band(vec![(0.0, 0.5, 1.5), (1.0, 1.5, 2.5)]))];
        Picture::Chart(Chart { title: "cell & <1>".into(), y: Axis::number("V"), layers, ..Chart::default() })
    }

    #[test]
    fn a_file_stands_alone_and_a_bad_path_is_reported() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("plot.svg");
        write(&path, &picture(), Format::Svg).expect("drawn");
        let text = std::fs::read_to_string(&path).expect("readable");
        assert!(text.starts_with("<svg") && text.trim_end().ends_with("</svg>"));
        assert!(text.contains("cell &amp; &lt;1&gt;") && text.contains("prefers-color-scheme:dark"));
        let error = write(&folder.path().join("no/such.svg"), &picture(), Format::Svg).expect_err("no folder");
        assert!(error.to_string().contains("such.svg: the plot cannot be written"), "{error}");
    }

    #[test]
    fn a_png_has_colours_or_says_that_there_is_no_font() {
        match png(&document(&[picture()], &fixed())) {
            Ok(bytes) => {
                let pixels = Pixmap::decode_png(&bytes).expect("a PNG");
                let is_blue = |p: &resvg::tiny_skia::PremultipliedColorU8| p.blue() > p.red().saturating_add(20);
                assert!(pixels.pixels().iter().filter(|p| is_blue(p)).count() > 1000, "no band in it");
            }
            Err(error) => assert!(error.contains("no font is installed"), "{error}"),
        }
    }

    #[test]
    fn the_style_of_a_png_has_no_variables() {
        assert!(!fixed().contains("var(") && !fixed().contains("@media"));
    }
}
