"""What people ask for that no synthetic clip does [ours]; a caption nearer to one of these means it."""

from __future__ import annotations

_DONE = """
swims, swims front crawl in a pool, dives into the water, floats on water, rows a boat, paddles a kayak,
surfs a wave, rides a bicycle, rides a horse, rides a skateboard, drives a car, steers with a wheel, flies
through the air, skates on ice, skis down a slope, slides down, climbs a ladder, climbs a wall, climbs
stairs, walks down the stairs, walks sideways, sidesteps, walks on their hands, tiptoes, limps, staggers,
stumbles, trips and falls, falls down, faints, slips, marches, sneaks, kneels down, kneels on one knee,
stands up from a chair, gets up, gets up from the floor, stands still, stands on one leg, freezes, waits,
balances on a beam, lunges, does push-ups, does sit-ups, does pull-ups, does a plank, does burpees, does
jumping jacks, lifts weights, lifts a knee, lifts a leg, does a handstand, does a cartwheel, does a
backflip, does a somersault, rolls over, does the splits, does yoga, meditates, breathes deeply, swings on a
rope, hangs from a bar, throws a ball, throws a stone, catches a ball, dribbles a basketball, shoots a
basketball, plays tennis, plays golf, plays baseball and swings a bat, plays volleyball, plays table tennis,
bowls, plays football, plays a video game, plays chess, plays cards, plays hopscotch, juggles, spins a hula
hoop, shoots an arrow with a bow, shoots a gun, aims a rifle, fights with a sword, wrestles, blocks a blow,
dodges, elbows somebody, headbutts, slaps, strangles, pushes, pushes a heavy box, pulls a rope, drags
something, carries a box, carries a tray, holds a baby, rocks a baby, puts something down, drops something,
hands something over, shakes hands, hugs, kisses, blows a kiss, high fives, bumps fists, pats somebody on
the back, tickles, salutes, shrugs, nods, shakes the head, tilts the head, looks around, looks up, looks
over the shoulder, looks at a watch, rolls the eyes, winks, smiles, laughs, cries, yawns, sneezes, coughs,
sleeps, wakes up, sings, talks, shouts, whispers, whistles, listens to the phone, makes a phone call, takes
a photo, takes a selfie, types on a keyboard, uses a computer, writes, draws, paints a wall, reads a book,
turns a page, opens a door, closes a window, locks a door with a key, knocks on a door, rings a bell,
presses a button, turns a knob, eats, drinks from a cup, pours tea, cooks and stirs a pot, chops vegetables,
kneads dough, washes the dishes, washes hands, brushes teeth, combs hair, shaves, puts on makeup, takes a
shower, gets dressed, takes off a jacket, puts on shoes, ties shoelaces, ties a tie, irons clothes, folds a
shirt, sews, knits, sweeps the floor, mops the floor, vacuums, cleans a window, digs a hole, rakes leaves,
waters plants, picks fruit, chops wood, saws wood, hammers a nail, drills a hole, uses a screwdriver, fixes
a machine, changes a tyre, fishes, smokes a cigarette, lights a candle, plays the guitar, plays the piano,
plays the violin, plays the drums, plays the flute, conducts an orchestra, does a magic trick, prays, gives
a speech, teaches a class, thinks, scratches the head, rubs the eyes, touches the nose, covers the face,
covers the ears, puts hands on hips, crosses the arms, folds the hands, crosses the legs, puts hands in
pockets, holds hands, gives a thumbs up, makes a peace sign, snaps the fingers, counts on the fingers,
wiggles the fingers, makes a fist, beckons, pounds on the table, swings the arms, circles the arms, rolls
the shoulders, rotates the hips, wiggles the hips, shakes the body, shivers, flaps like a bird, flexes the
muscles, moves the wrist, bends the elbow, stamps the foot, taps the foot, swings a leg, steps over
something, steps aside, leans on a wall, rolls on the floor, hides, searches for something, packs a bag,
lifts a suitcase, opens an umbrella, throws away rubbish, buys something and pays, counts money, plays with
a dog, feeds an animal, milks a cow, does ballet and pirouettes, does a curtsy, performs a gymnastics
routine, dies, transforms, works, exists, enters a code on a keypad, punches holes into paper, turns on a
machine, runs a program, opens a tap, gives up a habit, jumps to a conclusion, makes a decision, feels
happy, is hungry, has an idea
"""
_NOT_DONE = """
the weather is nice, the news of today, a sentence about business, a greeting without a motion, a list of
numbers, a random string of letters, a colour, food on a table
"""


def _listed(text: str) -> list[str]:
    return [" ".join(one.split()) for one in text.split(",")]


OTHER_ACTIONS = (*(f"a person {one}" for one in _listed(_DONE)), *_listed(_DONE), *_listed(_NOT_DONE))
"""Each as a sentence, and as an order."""
