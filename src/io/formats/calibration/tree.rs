//! Files of named fields, as one kind of tree.

use roxmltree::{Document, Node};
use serde_json::{Map, Value};

use super::super::pickle;
use super::Fault;

/// The first bytes of a recording.
const RECORDING: &[u8] = mcap::MAGIC;

/// A file's content and what kind it is.
pub(super) enum Content {
    /// Fields, and the kind of file.
    Tree(Value, &'static str),
    /// XML of other programs.
    Xml(String),
}

/// Reads a file by its content: a pickle, XML, JSON, TOML or YAML. `name` tells what a broken file should be.
pub(super) fn content(bytes: &[u8], name: &str) -> Result<Content, Fault> {
    if bytes.first() == Some(&pickle::PROTOCOL) {
        return Ok(Content::Tree(pickle::value(bytes).map_err(Fault::Text)?, "pickle"));
    }
    if bytes.starts_with(RECORDING) {
        let fix = "`bundlemocap rig convert FILE --out rig.toml` takes its calibration";
        return Err(Fault::Text(format!("a recording; {fix}")));
    }
    let text = decoded(bytes).ok_or_else(|| Fault::Text("neither text nor a pickle".into()))?;
    let text = text.trim_start_matches('\u{feff}').trim_start();
    if text.starts_with('<') {
        return match text.contains("<opencv_storage") {
            true => Ok(Content::Tree(opencv_xml(text)?, "OpenCV XML")),
            false => Ok(Content::Xml(text.to_owned())),
        };
    }
    let json = match serde_json::from_str(text) {
        Ok(value) => return Ok(Content::Tree(value, "JSON")),
        Err(error) => error,
    };
    let toml = match toml::from_str(text) {
        Ok(value) => return Ok(Content::Tree(value, "TOML")),
        Err(error) => error,
    };
    let yaml = match yaml(text) {
        Ok(value) if value.is_object() => return Ok(Content::Tree(value, "YAML")),
        Ok(_) => "it holds no fields".to_owned(),
        Err(error) => error.to_string(),
    };
    Err(Fault::Text(match name.rsplit('.').next() {
        Some("json") => format!("not JSON: {json}"),
        Some("yml" | "yaml") => format!("not YAML: {yaml}"),
        _ if text.starts_with('{') => format!("not JSON: {json}"),
        _ if text.starts_with("%YAML") => format!("not YAML: {yaml}"),
        _ => toml_fault(text, &toml),
    }))
}

/// UTF-8, or UTF-16 with or without a mark.
fn decoded(bytes: &[u8]) -> Option<String> {
    let wide = |unit: fn([u8; 2]) -> u16| {
        let units: Vec<u16> = bytes.chunks_exact(2).map(|two| unit([two[0], two[1]])).collect();
        String::from_utf16(&units).ok()
    };
    match bytes {
        [0xff, 0xfe, ..] | [_, 0, ..] => wide(u16::from_le_bytes),
        [0xfe, 0xff, ..] | [0, ..] => wide(u16::from_be_bytes),
        _ => String::from_utf8(bytes.to_owned()).ok(),
    }
}

/// YAML. OpenCV's own header and tags are no YAML of today; its lines stay, for the numbers of lines.
fn yaml(text: &str) -> serde_yaml::Result<Value> {
    let is_header = |line: &str| line.starts_with("%YAML") || line.starts_with("---");
    let lines = text.lines().map(|line| if is_header(line) { "" } else { line });
    let text = lines.collect::<Vec<_>>().join("\n");
    serde_yaml::from_str(&text.replace("!!opencv-matrix", "").replace("!!opencv-nd-matrix", ""))
}

/// The tree of OpenCV's XML: numbers, lists of numbers or texts, and matrices.
fn opencv_xml(text: &str) -> Result<Value, Fault> {
    let document = Document::parse(text).map_err(|e| Fault::Text(format!("not XML: {e}")))?;
    Ok(of_node(document.root_element()))
}

fn of_node(node: Node) -> Value {
    let children: Vec<Node> = node.children().filter(Node::is_element).collect();
    if children.iter().any(|child| child.has_tag_name("_")) {
        return children.into_iter().map(of_node).collect();
    }
    if !children.is_empty() {
        let fields =
            children.into_iter().map(|child| (child.tag_name().name().to_owned(), of_node(child)));
        return Value::Object(Map::from_iter(fields));
    }
    let words: Vec<&str> = node.text().unwrap_or_default().split_whitespace().collect();
    let texts = || words.iter().map(|word| Value::from(word.trim_matches('"')));
    let numbers: Option<Vec<f64>> = words.iter().map(|word| word.parse().ok()).collect();
    match (numbers, &words[..]) {
        _ if node.has_tag_name("names") => texts().collect(),
        // Whole numbers are also names and switches.
        (Some(numbers), [word]) => {
            word.parse::<i64>().map_or_else(|_| Value::from(numbers[0]), Value::from)
        }
        (Some(numbers), _) => Value::from(numbers),
        (None, _) => Value::from(words.join(" ").trim_matches('"')),
    }
}

/// The error message on one line, with the line number of the fault.
fn toml_fault(text: &str, error: &toml::de::Error) -> String {
    let message = error.message().lines().collect::<Vec<_>>().join(", ");
    let line = error.span().map(|span| text[..span.start.min(text.len())].lines().count().max(1));
    match line {
        Some(line) => format!("line {line} is not TOML: {message}"),
        None => format!("not TOML: {message}"),
    }
}
