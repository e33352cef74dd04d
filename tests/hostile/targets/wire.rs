//! What peers send: frames, programs, protobuf messages; and what plug-ins say.

use std::fmt::Debug;

use farm_core::{
    coordinator::{
        FarmStatus,
        policy::{Choice, Question},
        timeline::{Segment, TimelineHead},
    },
    message::{
        AppToCoordinator, AppToNode, CoordinatorToApp, CoordinatorToNode, NodeToApp, NodeToCoordinator,
    },
    program::{ProgramQuota, validate},
};
use proto::{
    codec,
    control::{self, MessageError, v1},
    link,
};

use super::{Verdict, refused};

/// Frames that an application sends, with the programs of its jobs.
pub(super) fn frames_to_node(bytes: &[u8]) -> Verdict {
    let frames = link::decode_frames::<AppToNode>(bytes.to_vec().into()).map_err(refused)?;
    for frame in frames {
        if let AppToNode::Jobs(tickets) = &frame.header {
            for program in codec::unpack_programs(frame.payload, tickets.len()).map_err(refused)? {
                job_program(&program)?;
            }
        }
    }
    Ok(())
}

pub(super) fn frames_to_app(bytes: &[u8]) -> Verdict {
    link::decode_frames::<NodeToApp>(bytes.to_vec().into()).map(drop).map_err(refused)
}

/// A program, and the check that a node makes before it runs it.
pub(super) fn job_program(bytes: &[u8]) -> Verdict {
    let program = codec::decode_program(bytes).map_err(refused)?;
    validate(&program, &ProgramQuota::default()).map_err(refused)?;
    let again = codec::encode_program(&program).map_err(refused)?;
    assert!(
        codec::decode_program(&again).is_ok_and(|other| other == program),
        "a valid program comes back another"
    );
    Ok(())
}

/// The number of programs in the first two bytes, then the payload.
pub(super) fn packed_programs(bytes: &[u8]) -> Verdict {
    let (count, payload) = bytes.split_first_chunk().ok_or("no count")?;
    let count = usize::from(u16::from_le_bytes(*count));
    codec::unpack_programs(payload.to_vec().into(), count).map(drop).map_err(refused)
}

/// A message that is taken in can be sent on, and means the same.
fn message<W, D>(
    decode: impl Fn(&[u8]) -> Result<D, MessageError>,
    encode: impl Fn(D) -> W,
    bytes: &[u8],
) -> Verdict
where
    W: AsRef<[u8]>,
    D: Clone + PartialEq + Debug,
{
    let taken = decode(bytes).map_err(refused)?;
    let again = decode(encode(taken.clone()).as_ref());
    assert!(again.as_ref() == Ok(&taken), "{taken:?} was taken in, and comes back as {again:?}");
    Ok(())
}

pub(super) fn app_to_coordinator(bytes: &[u8]) -> Verdict {
    // What is held comes back grouped: the order is not part of its meaning.
    let mut taken = control::decode::<v1::AppToCoordinator, AppToCoordinator>(bytes).map_err(refused)?;
    let again = control::encode::<v1::AppToCoordinator, _>(taken.clone());
    let mut again = control::decode::<v1::AppToCoordinator, AppToCoordinator>(&again).map_err(refused)?;
    for message in [&mut taken, &mut again] {
        if let AppToCoordinator::Plan(request) = message {
            request.held.sort_by_key(|job| (job.session, job.device, job.attempt, job.index));
        }
    }
    assert_eq!(again, taken, "a message comes back another");
    Ok(())
}

pub(super) fn coordinator_to_app(bytes: &[u8]) -> Verdict {
    message(
        control::decode::<v1::CoordinatorToApp, CoordinatorToApp>,
        control::encode::<v1::CoordinatorToApp, _>,
        bytes,
    )
}

pub(super) fn node_to_coordinator(bytes: &[u8]) -> Verdict {
    message(
        control::decode::<v1::NodeToCoordinator, NodeToCoordinator>,
        control::encode::<v1::NodeToCoordinator, _>,
        bytes,
    )
}

pub(super) fn coordinator_to_node(bytes: &[u8]) -> Verdict {
    message(
        control::decode::<v1::CoordinatorToNode, CoordinatorToNode>,
        control::encode::<v1::CoordinatorToNode, _>,
        bytes,
    )
}

pub(super) fn farm_status(bytes: &[u8]) -> Verdict {
    message(
        control::decode::<v1::FarmStatus, FarmStatus>,
        control::encode::<v1::FarmStatus, FarmStatus>,
        bytes,
    )
}

pub(super) fn timeline_head(bytes: &[u8]) -> Verdict {
    message(
        control::decode::<v1::TimelineHead, TimelineHead>,
        control::encode::<v1::TimelineHead, TimelineHead>,
        bytes,
    )
}

pub(super) fn timeline_segments(bytes: &[u8]) -> Verdict {
    message(
        control::decode::<v1::TimelineSegments, Vec<Segment>>,
        |segments: Vec<Segment>| control::encode::<v1::TimelineSegments, _>(&*segments),
        bytes,
    )
}

/// A line of the coordinator's to a plug-in's process.
pub(super) fn plugin_question(bytes: &[u8]) -> Verdict {
    serde_json::from_slice::<Question>(bytes).map(drop).map_err(refused)
}

/// A line of a plug-in's process.
pub(super) fn plugin_answer(bytes: &[u8]) -> Verdict {
    serde_json::from_slice::<Result<Vec<Choice>, String>>(bytes).map(drop).map_err(refused)
}
