//! Admission: refuses a deployment that asks for more than the vehicle has.

use std::collections::BTreeMap;

use gleaner_base::{ByteSize, Exit, Failure};
use gleaner_lambda::manifest::{ItemName, LambdaKind};
use gleaner_lambda::{Manifest, Vehicle};
use gleaner_protocol::vehicle_api::Capacity;

/// Memory of the process of a lambda beside what its limits count, as measured with the examples:
/// host and shim of a component; interpreter and numpy of a Python lambda.
const WASM_PROCESS: ByteSize = ByteSize::mib(24);
const PYTHON_PROCESS: ByteSize = ByteSize::mib(96);

/// The memory that all lambdas together may ask for.
#[derive(Debug)]
pub(crate) struct MemoryBudget {
    most: u64,
    source: String,
}

impl MemoryBudget {
    /// Returns the budget of the configuration, or else half of the machine's memory.
    pub(crate) fn of(vehicle: &Vehicle) -> Self {
        match vehicle.deployments.memory {
            Some(size) => {
                Self { most: size.bytes(), source: "`deployments.memory` in vehicle.toml".into() }
            }
            None => {
                Self { most: total_memory() / 2, source: "half of the machine's memory".into() }
            }
        }
    }

    /// Admits a deployment that asks for `asked`, beside the others in `admitted`.
    ///
    /// # Errors
    ///
    /// A failure that names both numbers.
    pub(crate) fn admit(
        &self,
        id: &ItemName,
        asked: u64,
        admitted: &BTreeMap<ItemName, u64>,
    ) -> Result<(), Failure> {
        let others: u64 = admitted.iter().filter(|(it, _)| *it != id).map(|(_, bytes)| bytes).sum();
        if others.saturating_add(asked) <= self.most {
            return Ok(());
        }
        let [asked, others, most] = [asked, others, self.most].map(ByteSize::new);
        let message = format!("there is no memory for deployment `{id}`");
        let mut failure = Failure::new(Exit::Denied, message);
        failure.causes = vec![format!(
            "it asks for {asked}, the other deployments for {others}, and all may ask for {most} \
             ({})",
            self.source
        )];
        Err(failure.with_help(
            "lower `memory` in the lambda's [limits], stop another deployment, or raise \
             `deployments.memory` in vehicle.toml",
        ))
    }

    pub(crate) fn capacity(&self, asked: u64) -> Capacity {
        Capacity {
            resource: "memory".to_owned(),
            unit: "B".to_owned(),
            asked: asked as f64,
            most: self.most as f64,
            source: self.source.clone(),
        }
    }
}

/// Returns the memory that a lambda may take, by the largest of its manifests: its own, as much
/// again for frames and tensors, its scratch space, its preroll in memory, and its process.
pub(crate) fn memory(manifests: &[Manifest]) -> u64 {
    let of = |manifest: &Manifest| {
        let limits = &manifest.limits;
        let process = match manifest.lambda.kind {
            LambdaKind::Wasm => WASM_PROCESS,
            LambdaKind::Python => PYTHON_PROCESS,
        };
        let preroll = manifest.record.as_ref().map_or(0, |record| record.preroll_size.bytes());
        [2 * limits.memory.bytes(), limits.scratch.bytes(), preroll, process.bytes()].iter().sum()
    };
    manifests.iter().map(of).max().unwrap_or(0)
}

/// Returns the memory of this machine, in bytes.
fn total_memory() -> u64 {
    let info = rustix::system::sysinfo();
    u64::from(info.mem_unit).saturating_mul(info.totalram)
}
