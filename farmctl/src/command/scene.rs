//! `farmctl scene`: writes one of the shipped scenes as a folder that every renderer of OBJ can read too.

use bdpt_kernel::generate::{self, SceneKind};

use crate::{cli::SceneArgs, failure::Failure, output::print_text};

/// Writes a scene, or lists their names.
pub(crate) fn run(arguments: &SceneArgs) -> Result<(), Failure> {
    if arguments.name == "list" {
        return print_text(&(SceneKind::NAMES.join("\n") + "\n"));
    }
    let usage = |error: anyhow::Error| Failure::Usage(error);
    let mut kind: SceneKind = arguments.name.parse().map_err(|error| usage(anyhow::Error::new(error)))?;
    if let Some(triangles) = arguments.triangles {
        kind = kind.with_triangles(triangles).map_err(|error| usage(error.into()))?;
    }
    let Some(folder) = &arguments.folder else {
        return Err(usage(anyhow::anyhow!("name the folder: farmctl scene {} FOLDER", arguments.name)));
    };
    let written = generate::write(kind, folder)?;
    print_text(&format!("{}\n", written.display()))
}
