//! The layers: a module imports only from modules above it in the table of `src/lib.rs`, and the
//! files of a folder have no import cycles.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Files that may import each other in a circle: the folder, the files, the reason.
const CIRCLES: [(&str, &str, &str); 1] = [(
    "core/tracker",
    "idle, playout, state_machine, window",
    "one state machine, `Tracker`, in several files",
)];

/// The place of each module in the table, and of each part as `module::part`.
type Table = BTreeMap<String, usize>;

/// Reads rows like ``| [`io`] | `wire`, `bus` | ... |``.
fn table(lib: &str) -> Table {
    let names = |cell: &str| -> Vec<String> {
        cell.split('`').skip(1).step_by(2).map(str::to_owned).collect()
    };
    let layers = lib.split("# Layers").nth(1).unwrap_or_default();
    let layers = layers.split("//! # ").next().unwrap_or_default();
    let mut all = Vec::new();
    for row in layers.lines().filter_map(|line| line.strip_prefix("//! |")) {
        let mut cells = row.split('|');
        let Some(module) = names(cells.next().unwrap_or_default()).pop() else { continue };
        let parts = names(cells.next().unwrap_or_default());
        all.extend(parts.into_iter().map(|part| format!("{module}::{part}")));
        all.push(module);
    }
    all.into_iter().enumerate().map(|(place, name)| (name, place)).collect()
}

/// The sources of a folder without those of crates of their own.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut found: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| !path.join("Cargo.toml").exists())
        .flat_map(|path| if path.is_dir() { sources(&path) } else { vec![path] })
        .filter(|path| path.extension().is_some_and(|extension| extension == "rs"))
        .collect();
    found.sort();
    found
}

/// The code without comments and without the tests at its end.
fn code(text: &str) -> String {
    let text = text.split("\n#[cfg(test)]").next().unwrap_or_default();
    let text = text.split("\n#[cfg(all(test,").next().unwrap_or_default();
    text.lines().filter(|line| !line.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n")
}

/// All paths after `prefix`, groups expanded: `prefix{a::{x, y}, b}` gives `a::x`, `a::y` and `b`.
fn paths(code: &str, prefix: &str) -> Vec<String> {
    let is_name = |c: char| c.is_alphanumeric() || c == '_';
    code.match_indices(prefix)
        .filter(|(at, _)| !code[..*at].ends_with(|c: char| is_name(c) || c == ':'))
        .flat_map(|(at, _)| expand(&code[at + prefix.len()..]))
        .collect()
}

/// The paths at the beginning of a text.
fn expand(text: &str) -> Vec<String> {
    let text = text.trim_start();
    if let Some(group) = text.strip_prefix('{') {
        return branches(group).iter().flat_map(|branch| expand(branch)).collect();
    }
    let name: String = text.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
    match text[name.len()..].strip_prefix("::") {
        Some(rest) if !name.is_empty() => {
            expand(rest).iter().map(|rest| format!("{name}::{rest}")).collect()
        }
        _ => vec![name],
    }
}

/// Splits `a::{b, c}, d}...` at the commas outside inner braces, up to the closing brace.
fn branches(group: &str) -> Vec<String> {
    let (mut depth, mut all) = (0, vec![String::new()]);
    for c in group.chars() {
        match c {
            '}' if depth == 0 => break,
            ',' if depth == 0 => all.push(String::new()),
            _ => {
                depth += i32::from(c == '{') - i32::from(c == '}');
                all.last_mut().unwrap().push(c);
            }
        }
    }
    all
}

/// The module path of a source file below `src`, such as `core::cost::path`.
fn module_of(inside: &Path) -> Vec<String> {
    let mut parts: Vec<String> =
        inside.with_extension("").iter().map(|part| part.to_string_lossy().into_owned()).collect();
    if parts.last().is_some_and(|last| last == "mod") {
        parts.pop();
    }
    parts
}

/// The absolute paths that the code of `module` uses: after `crate::`, and after any number of
/// `super::`.
fn used(code: &str, module: &[String]) -> Vec<Vec<String>> {
    let split = |path: &str| path.split("::").map(str::to_owned).collect::<Vec<_>>();
    let mut all: Vec<Vec<String>> = paths(code, "crate::").iter().map(|path| split(path)).collect();
    for path in paths(code, "super::") {
        let ups = 1 + path.split("::").take_while(|part| *part == "super").count();
        let rest = split(&path).into_iter().skip(ups - 1);
        let above = module.iter().take(module.len().saturating_sub(ups)).cloned();
        all.push(above.chain(rest).collect());
    }
    all
}

/// The entry of the table that a path belongs to: `module::part` if there is one, else `module`.
fn entry<'p>(table: &Table, path: &'p [String]) -> Option<(String, &'p [String])> {
    let [module, rest @ ..] = path else { return None };
    let part = rest.first().map(|part| format!("{module}::{part}"));
    let known = part.filter(|part| table.contains_key(part));
    known.or_else(|| table.contains_key(module).then(|| module.clone())).map(|name| (name, rest))
}

#[test]
fn modules_import_only_from_layers_above() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let table = table(&fs::read_to_string(root.join("lib.rs")).unwrap());
    assert!(table.len() > 20, "the table of layers in src/lib.rs cannot be read: {table:?}");
    let mut wrong = Vec::new();
    for file in sources(&root) {
        let inside = file.strip_prefix(&root).unwrap();
        let module = module_of(inside);
        if ["lib", "main"].contains(&module[0].as_str()) || inside.ends_with("tests.rs") {
            continue;
        }
        let Some((from, _)) = entry(&table, &module) else {
            wrong.push(format!("{}: not in the table", inside.display()));
            continue;
        };
        let code = code(&fs::read_to_string(&file).unwrap());
        for path in used(&code, &module) {
            match entry(&table, &path) {
                Some((to, _))
                    if table[&to] <= table[&from] || !to.contains("::") && to == module[0] => {}
                Some((to, _)) => wrong.push(format!("{} imports `{to}`", inside.display())),
                // A name that lib.rs or a mod.rs re-exports.
                None if path.len() < 2 => {}
                None => wrong.push(format!(
                    "{}: `{}` is not in the table",
                    inside.display(),
                    path.join("::")
                )),
            }
        }
    }
    assert!(wrong.is_empty(), "imports against the layers:\n{}", wrong.join("\n"));
}

/// Functions whose last bits depend on the system's library.
const OF_THE_SYSTEM: [&str; 22] = [
    "sin", "cos", "tan", "sin_cos", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "exp",
    "exp2", "exp_m1", "ln", "ln_1p", "log", "log2", "log10", "powf", "cbrt", "hypot",
];

/// The node makes recordings, so it belongs to what must give the same bits.
#[test]
fn core_and_node_call_no_function_of_the_system_whose_bits_differ() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let files = ["core", "io/wire", "live"].iter().flat_map(|room| sources(&root.join(room)));
    for path in files.filter(|path| !path.ends_with("core/random.rs")) {
        let code = code(&fs::read_to_string(&path).unwrap());
        for name in OF_THE_SYSTEM {
            let called =
                code.contains(&format!(".{name}(")) || code.contains(&format!("f64::{name}"));
            assert!(!called, "{}: use libm instead of `{name}`", path.display());
        }
    }
}

/// Who imports whom among the files and folders directly in `folder`.
fn imports_within(folder: &Path, root: &Path) -> BTreeMap<String, BTreeSet<String>> {
    let base = module_of(folder.strip_prefix(root).unwrap());
    let base: Vec<String> = if base == [""] { Vec::new() } else { base };
    let mut graph: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    let mut all = Vec::new();
    for file in sources(folder) {
        let module = module_of(file.strip_prefix(root).unwrap());
        let Some(room) = module.get(base.len()) else { continue };
        all.push((room.clone(), used(&code(&fs::read_to_string(&file).unwrap()), &module)));
        graph.entry(room.clone()).or_default();
    }
    for (room, paths) in all {
        for path in paths {
            let inner = path.strip_prefix(base.as_slice()).and_then(|inner| inner.first());
            if let Some(other) = inner.filter(|other| **other != room && graph.contains_key(*other))
            {
                let other = other.clone();
                graph.entry(room.clone()).or_default().insert(other);
            }
        }
    }
    graph
}

/// The files in import cycles and between them; empty if there is no cycle.
fn circles(graph: &BTreeMap<String, BTreeSet<String>>) -> Vec<String> {
    let mut left = graph.clone();
    loop {
        let imported: BTreeSet<String> = left.values().flatten().cloned().collect();
        let before = left.len();
        let names: BTreeSet<String> = left.keys().cloned().collect();
        left.retain(|name, to| imported.contains(name) && !to.is_disjoint(&names));
        if left.len() == before {
            return left.into_keys().collect();
        }
    }
}

#[test]
fn files_of_a_folder_have_no_import_cycles() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let folders: BTreeSet<PathBuf> =
        sources(&root).iter().filter_map(|file| file.parent().map(Path::to_owned)).collect();
    let mut wrong = Vec::new();
    for folder in folders {
        let name = folder.strip_prefix(&root).unwrap().display().to_string();
        let excused = CIRCLES.iter().find(|(folder, ..)| *folder == name);
        let expected = excused.map_or("", |(_, files, _)| files);
        let found = circles(&imports_within(&folder, &root)).join(", ");
        if found != expected {
            wrong.push(format!("src/{name}: found {found:?}, expected {expected:?}"));
        }
    }
    assert!(wrong.is_empty(), "files that import each other in a circle:\n{}", wrong.join("\n"));
}

#[test]
fn the_checks_find_violations() {
    let table = table(
        "//! # Layers\n//! | [`core`] | `time`, `so3` | x |\n//! | [`io`] | | y |\n//! # End",
    );
    assert!(table["core::time"] < table["core::so3"] && table["core"] < table["io"]);
    let text = "use crate::{a::{x, y}, b};\nuse super::super::q::r;\n// crate::no\nlet z = crate::c::d();\n\
                #[cfg(test)]\nmod tests { crate::t";
    let here: Vec<String> = ["m", "n", "f"].map(str::to_owned).into();
    let used: Vec<String> = used(&code(text), &here).iter().map(|path| path.join("::")).collect();
    assert_eq!(used, ["a::x", "a::y", "b", "c::d", "m::q::r"]);
    let graph = |arrows: &[(&str, &str)]| {
        let mut graph: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
        for (from, to) in arrows {
            graph.entry((*from).into()).or_default().insert((*to).into());
            graph.entry((*to).into()).or_default();
        }
        graph
    };
    assert!(circles(&graph(&[("a", "b"), ("b", "c")])).is_empty());
    assert_eq!(circles(&graph(&[("d", "a"), ("a", "b"), ("b", "a"), ("b", "c")])), ["a", "b"]);
}
