"""Groups of models by what they are for, so that rules can ask for "a sofa"."""

from __future__ import annotations

from worlds.library import Library, Model

MAX_TRIANGLES = 130_000  # a more detailed model would take a second of a world's two
# Names of catalogue models, as in "Scopia#bed1" after the mark.
GROUPS: dict[str, str] = {
    "sofa": (
        "sofa couch sofa2 couch2 winchesterSofa sofa3 couch3 futon-couch "
        "mid-century-bench-sofa mid-century-sofa clear_sofa simple_sofa beige_sofa_2seats "
        "beige_sofa burlap_sofa leather_sofa sofa_white_beige L_shaped_sofa cornerSofa "
        "convertible-sofa-BZ-closed rattanSofa"
    ),
    "armchair": (
        "armchair armchair1 armchair2 armchair3 winchesterArmchair fotel mid-century-chair "
        "chair-ottoman leaf_chair modernArmchair designChair modern_armchair armChair2 puff "
        "osakaChair rattanArmchair silla_teca"
    ),
    "chair": (
        "chair chair2 chair3 chair4 oakChair plasticChair sillaBlanca antiqueChair thonet "
        "chairWithCushion cafe_set_mota_chair cafe_set_tonon_chair ella_chair_f plaidChair "
        "kitchenChair dining-chair tubular_chair plastic_chair white_kitchen_chair "
        "foldingChair"
    ),
    "stool": (
        "stool stool2 silla2 bar-stool bar_chair kitchen_stool green_stool pianoBench "
        "children_chair"
    ),
    "dining_table": (
        "oakTable table table4 black_table white_kitchen_table table-on-trestles "
        "table-with-leaning-feet round-table wooden_table_office folding-table tableWithTablecloth "
        "wooden_office_pear_table_rect cafe_set_mota_table table3"
    ),
    "coffee_table": (
        "coffeeTable saloon_table living_room_table table_wood_and_iron coffee-table2 "
        "rattanTable ext_table bench"
    ),
    "desk": (
        "desk lbDesk biurko3 simpleDesk officeTable custom-desk kids_desk_table "
        "kids_wooden_desk wooden_office_alder_table wooden_office_pear_table "
        "wooden_office_teak_table technicalTable1"
    ),
    "desk_chair": "office-chair office_chair kids_desk_chair armchair armChair2 classSeat",
    "bed": (
        "bed1 bed2 bed3 bedWithTexture lettoCloud iron_bed captains-bed juniorBed "
        "children_bed day_bed_frame convertible-sofa-BZ-opened bunkBed"
    ),
    "kids_bed": "juniorBed children_bed bunkBed crib babyRockingBed captains-bed mezzanine-bed",
    "bedside": "bedsideTable bedsideTable2 green_stool",
    "wardrobe": "wardrobe wardrobe1 wardrobe2 wardrobeWithSlidingDoors cupboard",
    "sideboard": (
        "chest dresserWithDrawers tvStand televisionCabinet shelves changing-table "
        "dressing-table box_room filing-cabinet"
    ),
    "tv_stand": "tvStand shelves chest dresserWithDrawers",
    "tv": "led_tv tv",
    "bookcase": (
        "bookcase verticalShelves full-bookcase utility-shelving dining_room "
        "contemp_living_room kids_shelves office_furniture1 office_box cupboard"
    ),
    "piano": "pianoAQueue piano",
    "floor_plant": "plant yuccaPlant ficus decorativePlant mediumIndoorPlant spatifilum bamboo",
    "small_plant": (
        "littlePlant augalas cactus orchids luckyBamboo spider_plant succulentPlant tulip "
        "tulips white_lily maceta bonsai-tree calla_lily_with_roses littlePlant"
    ),
    "floor_lamp": "living_lamp JapaneseLantern",
    "table_lamp": (
        "desklamp lamp little_lamp1 little_lamp2 little_lamp3 livingroom_lamp1 table_lamp "
        "pedestal-vase-lamp desk_lamp1 desk_lamp2"
    ),
    "pendant": "hangingLight hanging-restaurant-light saloon_lamp lamp2",
    "ceiling_lamp": "ceiling-lamp fluorescent",
    "vase": "vase1 vase2 vase3 jar vase5 old_jar pottery candle complements2 deer",
    "living_small": (
        "book newspaper tv-remote-control dvd radio mobile iphone glasses sunglasses frame1 "
        "frame2 cup coffee-mug bowlWithFruits candle tablet chessboard gift mp3Station "
        "wirelessOfficePhone3 apples wine_bottle teapot basic_camera playstation4 caffe_final "
        "ps4-joystick rubix2 cardGame"
    ),
    "kitchen_small": (
        "butter caffe_final knifeStandSwap mamadeira plasticCup tetrapak yogurtBottle bread "
        "coffeeBrewer cupcake hotDog beer_bottle boiler choppingBoard coffee_cup kitchenKnife "
        "largePan breadBox kitchenScale utensilsPot coffeePress espressokettle hamburger "
        "saltShaker bowl coffee-maker coffee-mug dinner-plate red-wine-bottle-01 wine_bottle "
        "apples creamer cup sugar teapot birthday_cake squeezer bowlWithFruits bowlWithSalad "
        "cooker electronicScale kitchenKnifeStandSet paperTowelHolder sandwichMaker "
        "spiceTower stoneGrillDevice toaster kitchenaid microwave roasted-chicken small-oven "
        "tray"
    ),
    "table_setting": (
        "plate-and-ustensils ensemble-assiette-couteau-fourchette-cuillere-verre dinner-plate "
        "cup bowl caffe_final"
    ),
    "office_small": (
        "cissors_swap ruler textMarker kalender stapler pencil1 bandeja penbox phone pencil2 "
        "inkjet_and_scanner_printer book newspaper coffee-mug tablet mobile headphones "
        "reflex_camera rouleau-de-ruban-adhesif tape-measure"
    ),
    "computer": "laptop apple-ibook-2001 apple-imac-1998 apple_pc",
    "bedroom_small": (
        "clock book frame1 handbag montre-with-pose glasses cosmeticsPot teddyBear "
        "folded_clothes chapeau casquette newspaper mobile lipStick flacon"
    ),
    "bath_small": (
        "cosmeticsPot flacon com_bath com_bath2_cepillo com_bath2_esponja "
        "com_bath2_jabon_pijo com_bath2_soap com_bath3_toalla medicoscopia_bottle "
        "medicoscopia_bottle2 medicoscopia_box lipStick comb"
    ),
    "toy": (
        "caballito cartoon_biplane housePuzzle teddyBear woodToy carrito-de-madera rubix2 "
        "toyTrain xylophone doll doll-house basketball ballonFoot tricycle skateboard scooter"
    ),
    "floor_clutter": (
        "slippers sneakers woman_shoes mocassin bootie backpack briefcase handbag "
        "cardboard-box open-cardboard-box basketball ballonFoot crate suitcase box shopping-basket "
        "recycling-bin clothes-basket gift dustbin wood_logs umbrellaFolded folded_clothes "
        "basin newspaper electricGuitar trunk-large"
    ),
    "pet": "cat dog siameseCat rabbit bulldog",
    "person": (
        "female01 female02 female03 male01 male02 male03 boyStanding girlStanding "
        "holdingFemale01 holdingFemale02 holdingMale01 female-01-casual-clothing male-01-suit"
    ),
    "sitting_person": "sitFemale03 sitMale01 sitMale02 girlSittingTable boySitting",
    "floor_person": "girlSittingGround sitFemale01 sitFemale02 boyLying lyingDownFemale01",
    "lower_cabinet": (
        "lowerCabinet drawersCabinet kitchenLowerCabinet kitchenDrawersCabinet "
        "kitchenSmallLowerCabinet"
    ),
    "sink": "sinkCabinet kitchenSink",
    "stove": "largeStove propane-stove",
    "upper_cabinet": (
        "upperCabinet glassDoorCabinet kitchenUpperCabinet kitchenGlassDoorCabinet "
        "kitchenSmallUpperCabinet upperShelves"
    ),
    "fridge": "refrigerator largeFridge fridge highCabinet",
    "hood": "hood rangeHood kitchenHood",
    "washer": "washing_machine clothes_washing_machine dryer_machine",
    "island": "kitchenIsland",
    "bath": "bath_jay_hardy corner_bathtub islandBath",
    "shower": "showerStall",
    "toilet": "toiletsUnit toilets_unit_jay_hardy modernToilet",
    "bidet": "bidet",
    "basin": (
        "washbasin washbasin_jay_hardy modernVanity bathroom_vanity double_vanity bathroom1 "
        "bathroom4 bathroom3"
    ),
    "towel_rack": "towel3 towel-rack com_bath3 bathroomRadiator radiatorAndTowels",
    "radiator": "radiator1 modernRadiator radiator radiator2",
    "fireplace": "fireplace1 fireplace2 furnace",
    "door": (
        "door double_door double_door_with_little_part puerta double_door_2 exterior-door-02 "
        "exterior-door-03 exterior-door-07 exterior-door-01"
    ),
    "wall_thing": (
        "wall-flat-tv cuckooClock dart_game wall-hanger switch-whites intercom "
        "internal-unity-air-conditioning wallLight"
    ),
    "hobby": (
        "poolTable table_football table_tennis flipper treadmill indoor-bike abdominalBench "
        "punching-ball fitnessTower piano electricGuitar workbench"
    ),
    "workshop": (
        "workbench ammoBox barrel crate pallet tableFan riggedFan fireExtinguisher "
        "step-ladder-metal step-ladder-wood cardboard-box open-cardboard-box clothes-horse mower "
        "bicycle bike wheelbarrow shopping-basket lockedLocker electric_water_heater_big "
        "chest-freezer suitcase recycling-bin residential-trashcan tricycle scooter2 "
        "wood_logs utility-shelving stroller japanese_style_screen water_cooler speaker3 "
        "whiteBoard"
    ),
    "tool": (
        "scie-egoine marteau tournevis perceuse-electrique meuleuse-electrique pince-coupante "
        "keys tape-measure rouleau-de-ruban-adhesif spray-bottle flashlight campingLamp radio "
        "cendrier tennisRacket tableTennisBat"
    ),
}


class Furniture:
    """The library's models by group."""

    def __init__(self, library: Library) -> None:
        """Look up the names of all groups; names that the library lacks are left out."""
        self.library = library
        by_name: dict[str, list[Model]] = {}
        for model in library.models:
            if 0 < model.triangles <= MAX_TRIANGLES:
                by_name.setdefault(model.entry.key.split("#")[1], []).append(model)
        self.groups = {
            group: [model for name in names.split() for model in by_name.get(name, [])]
            for group, names in GROUPS.items()
        }

    def of(self, group: str) -> list[Model]:
        """All models of a group; empty if the library has none."""
        return self.groups[group]
