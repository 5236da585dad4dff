//! Compiles `schemas/*.proto`: Rust types, and one descriptor file per schema for recordings.

use std::error::Error;
use std::path::{Path, PathBuf};

use prost_build::Config;
use protox::prost_reflect::prost_types::FileDescriptorSet;

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=build.rs");
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    let mut protos: Vec<PathBuf> = std::fs::read_dir("schemas")?
        .map(|entry| Ok(entry?.path()))
        .collect::<Result<_, std::io::Error>>()?;
    protos.retain(|path| path.extension().is_some_and(|extension| extension == "proto"));
    protos.sort();
    // Not the folder: it has Python too. For a new schema, touch this file.
    protos.iter().for_each(|proto| println!("cargo:rerun-if-changed={}", proto.display()));
    for proto in &protos {
        write_descriptor(proto, &out)?;
    }
    let all = protox::compile(&protos, ["schemas"])?;
    std::fs::write(out.join("messages.json"), fields_as_json(&all))?;
    let config = &mut Config::new();
    with_json(config.enable_type_names(), &all).compile_fds(all)?;
    Ok(())
}

/// The fields of all messages, for the page's decoder: by message and number, the name, the type, the name of
/// a message type, and whether it is repeated.
fn fields_as_json(all: &FileDescriptorSet) -> String {
    let messages = all.file.iter().flat_map(|file| &file.message_type).map(|message| {
        let fields = message.field.iter().map(|field| {
            let of = field.type_name().rsplit('.').next().unwrap_or_default();
            let (name, kind) = (field.name(), format!("{:?}", field.r#type()).to_lowercase());
            let is_repeated = field.label() as i32 == 3;
            format!(r#""{}":["{name}","{kind}","{of}",{is_repeated}]"#, field.number())
        });
        let fields = fields.collect::<Vec<_>>().join(",");
        format!(r#""{}":{{{fields}}}"#, message.name())
    });
    format!("{{{}}}", messages.collect::<Vec<_>>().join(",\n"))
}

/// Lets messages be written as JSON, as `src/io/wire/json.rs` says.
fn with_json<'a>(config: &'a mut Config, all: &FileDescriptorSet) -> &'a mut Config {
    let with = |function: &str| {
        format!("#[serde(serialize_with = \"crate::io::wire::json::{function}\")]")
    };
    config.type_attribute(".", "#[derive(serde::Serialize)]");
    config.enum_attribute(".", "#[serde(rename_all = \"snake_case\")]");
    config.field_attribute("bundlemocap.v1.JournalEntry.input", "#[serde(flatten)]");
    for (fields, function) in [
        (&["Pose.state", "Keyframe.state", "RetargetedPose.state"][..], "tracking_state"),
        (&["CalibratedCamera.lens"], "lens_kind"),
        (&["Status.events"], "event_counts"),
        (
            &["KeypointSet.rig_hash", "Take.id", "TakeAnswer.id", "JournalMessage.hash"],
            "hexadecimal",
        ),
        (
            &[
                "JournalStart.rig",
                "JournalStart.body",
                "JournalPerformer.body",
                "JournalMessage.payload",
            ],
            "length",
        ),
    ] {
        for field in fields {
            config.field_attribute(format!("bundlemocap.v1.{field}"), with(function));
        }
    }
    // Ids of runs, in each message that has one.
    for message in all.file.iter().flat_map(|file| &file.message_type) {
        if message.field.iter().any(|field| field.name() == "run_id") {
            let field = format!("bundlemocap.v1.{}.run_id", message.name());
            config.field_attribute(field, with("hexadecimal"));
        }
    }
    config
}

/// Writes the `FileDescriptorSet` of one schema, without comments, to `{name}.fds`.
fn write_descriptor(proto: &Path, out: &Path) -> Result<(), Box<dyn Error>> {
    let set = protox::Compiler::new(["schemas"])?
        .include_source_info(false)
        .include_imports(true)
        .open_file(proto)?
        .encode_file_descriptor_set();
    let name = proto.file_stem().ok_or("a schema without a name")?;
    std::fs::write(out.join(name).with_extension("fds"), set)?;
    Ok(())
}
